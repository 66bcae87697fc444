"""A training by the reference's kernels, as gaussian-splatting 2.11.0 of PyPI packs them, for a curve beside ours.

    python -m benchmarks.peers.reference_training -s SCENE -m OUT --eval [--seed N]
    python -m benchmarks.peers.curve -m OUT

By its README, the package keeps the reference's algorithms. Its licence allows research and evaluation. It reads
COLMAP scenes of pinholes itself: here a copy without the test photos. What its own loop prints is left out, which only
helps. Writes what `benchmarks.peers.timed` says.
"""

import argparse
import tempfile
from pathlib import Path

from arguments import ModelParams
from benchmarks.peers.timed import DEGREE, shuffled, train
from scene.readers.info import HOLD
from scene.scene import Scene
from utils.system_utils import UserError, compute_device, run_cli

MODE = "densify"  # "same with original 3DGS"


def without_test_photos(source: Path, images: str, out: Path) -> Path:
    """Write the training views of a COLMAP scene into the folder `out`, as text; its photos are a link."""
    import pycolmap  # after Pillow

    (out / "images").symlink_to((source / images).absolute())
    model = out / "sparse" / "0"
    model.mkdir(parents=True)
    pycolmap.Reconstruction(str(source / "sparse" / "0")).write_text(str(model))
    lines = [line for line in (model / "images.txt").read_text().splitlines() if not line.startswith("#")]
    views = sorted(zip(lines[::2], lines[1::2], strict=True), key=lambda view: view[0].split(maxsplit=9)[9])
    kept = [line for place, view in enumerate(views) if place % HOLD for line in view]
    (model / "images.txt").write_text("\n".join([*kept, ""]))
    return out


class Training:
    """The package's own trainer of its own model on its own cameras."""

    def __init__(self, source: Path, seed: int) -> None:
        try:
            from gaussian_splatting.train import prepare_training
        except ImportError as error:
            raise UserError(f"{error}; run pip install --no-build-isolation gaussian-splatting==2.11.0") from error
        cameras, self._gaussians, self._trainer = prepare_training(
            DEGREE, str(source), str(compute_device()), MODE, load_mask=False, load_depth=False
        )
        self._views = shuffled([cameras[place] for place in range(len(cameras))], seed)

    def __len__(self) -> int:
        return len(self._gaussians.get_xyz)

    def step(self, step: int) -> None:
        """An iteration."""
        self._trainer.step(next(self._views))

    def save(self, path: Path) -> None:
        """Write a PLY."""
        self._gaussians.save_ply(str(path))


def start(scene: Scene, options: ModelParams, args: argparse.Namespace) -> Training:
    """The training of a scene's training views."""
    if options.white_background or not (Path(options.source_path) / "sparse").is_dir():
        raise UserError("gaussian-splatting reads COLMAP scenes with a black background alone; give such a scene")
    with tempfile.TemporaryDirectory() as folder:
        training = Training(without_test_photos(Path(options.source_path), options.images, Path(folder)), args.seed)
    return training


if __name__ == "__main__":
    run_cli(lambda: train(argparse.ArgumentParser(description=__doc__.splitlines()[0]), start))
