"""Train and render a small scene, and print what that loaded and wrote, as JSON.

    python -m benchmarks.costs.probe FOLDER

It makes a small Blender scene in FOLDER, trains on it for 3 iterations and renders it. The output tells which modules,
sockets, files and test photos were used, and so which of them a run without their feature leaves alone.
"""

import argparse
import json
import math
import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageFile

MODULES = (
    *("pycolmap", "matplotlib", "tensorboard", "torch.utils.tensorboard", "socketserver", "lpips", "skimage", "scipy"),
    *("torch._dynamo", "torch.onnx", "torchvision", "sympy", "networkx", "triton", "pandas", "IPython"),
)
BEFORE = frozenset(sys.modules)  # by torch itself, NumPy and Pillow
SIZE = 32


def make_scene(folder: Path) -> None:
    """Write 4 training and 2 test frames, RGBA and opaque, with cameras on a circle of radius 4."""
    rng = np.random.default_rng(0)
    for split, count in (("train", 4), ("test", 2)):
        (folder / split).mkdir(parents=True)
        frames = []
        for index in range(count):
            pixels = rng.integers(0, 256, (SIZE, SIZE, 4), dtype=np.uint8)
            pixels[..., 3] = 255
            Image.fromarray(pixels).save(folder / split / f"r_{index}.png")
            angle = 2 * math.pi * index / count
            right, up, back = (math.cos(angle), math.sin(angle), 0), (0, 0, 1), (math.sin(angle), -math.cos(angle), 0)
            pose = np.eye(4)
            pose[:3] = np.column_stack([right, up, back, 4 * np.array(back)])
            frames.append({"file_path": f"./{split}/r_{index}", "transform_matrix": pose.tolist()})
        content = {"camera_angle_x": 0.7, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(content))


def probe(folder: Path) -> dict:
    """Train and render in `folder`; return what was seen.

    Keys: `modules`, those of MODULES that were loaded besides BEFORE; `binds`, the sockets bound; `files`, those
    written; `decoded`, the paths of decoded photos; `picture_bytes`, the memory of each training image, and `values`,
    its colour values.
    """
    scene, model = folder / "scene", folder / "model"
    make_scene(scene)
    binds, decoded = [], []
    sys.addaudithook(lambda event, args: binds.append(str(args[1])) if event == "socket.bind" else None)
    load = ImageFile.ImageFile.load

    def counting(image: ImageFile.ImageFile) -> object:
        if image.tile:  # not decoded yet
            decoded.append(str(Path(image.filename).relative_to(scene)))
        return load(image)

    ImageFile.ImageFile.load = counting
    import train
    from scene import Scene

    made: list[Scene] = []
    plain = Scene.__init__

    def keeping(self: Scene, *args: object, **options: object) -> None:
        made.append(self)
        plain(self, *args, **options)

    Scene.__init__ = keeping
    arguments = ["-s", str(scene), "-m", str(model), "--eval", "-r", "2", "--iterations", "3"]
    train.main([*arguments, "--test_iterations", "-1", "--no_curve", "--disable_viewer", "--quiet"])
    import render

    decoded_in_training = sorted(set(decoded))
    sys.argv = ["render.py", "-m", str(model), "--skip_train", "--skip_test", "--quiet"]
    render.main()
    pictures = [camera.target(torch.zeros(3)) for camera in made[0].getTrainCameras()]
    return {
        "modules": [name for name in MODULES if name in sys.modules and name not in BEFORE],
        "binds": binds,
        "files": sorted(str(file.relative_to(model)) for file in model.rglob("*") if file.is_file()),
        "decoded": decoded_in_training,
        "picture_bytes": [picture.untyped_storage().nbytes() for picture in pictures],
        "values": 3 * (SIZE // 2) ** 2,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="new folder for the scene and the model")
    folder = parser.parse_args().folder
    print(json.dumps(probe(folder)), file=sys.__stdout__)  # --quiet has silenced sys.stdout


if __name__ == "__main__":
    main()
