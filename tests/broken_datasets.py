"""Small scenes with one fault each, and the reader's messages for them."""

import argparse
import contextlib
import io
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch
from PIL import Image
from synthetic import make_blender_scene, make_colmap_scene

from arguments import ModelParams
from scene import Scene
from scene.gaussian_model import GaussianModel
from splatting.training.checks import check_scene
from utils.system_utils import UserError

Options = dict[str, Any]


class Fault(NamedTuple):
    """A fault: its description, the kind of scene it is made from, and the function that makes it and gives options."""

    what: str
    kind: str  # "colmap" or "blender"
    make: Callable[[Path], Options | None]


FAULTS: list[Fault] = []


def fault(kind: str, what: str) -> Callable:
    """Add a function to the list. It changes the scene that it gets, and may return options of train.py."""

    def enter(make: Callable[[Path], Options | None]) -> Callable[[Path], Options | None]:
        FAULTS.append(Fault(what, kind, make))
        return make

    return enter


def message(fault: Fault, masters: dict[str, Path], work: Path) -> str:
    """Train the faulty scene and return the UserError's message, with the folders as SCENE and OUT.

    Raises AssertionError if the scene is accepted.
    """
    scene = Path(shutil.copytree(masters[fault.kind], work / "scene"))
    options = {"source_path": str(scene), "model_path": str(work / "out"), **(fault.make(scene) or {})}
    extracted = ModelParams(argparse.ArgumentParser()).extract(argparse.Namespace(**options))
    quiet = io.StringIO()
    with contextlib.redirect_stdout(quiet), contextlib.redirect_stderr(quiet):
        try:
            taken = Scene(extracted, GaussianModel(3), start=False)
            check_scene(taken.info)
            taken.create_gaussians()
            for camera in taken.getTrainCameras():
                camera.target(torch.zeros(3))
        except UserError as error:
            return str(error).replace(str(scene), "SCENE").replace(str(work / "out"), "OUT")
    raise AssertionError(f"a scene with this fault is taken: {fault.what}")


def make_masters(folder: Path) -> dict[str, Path]:
    """Make the intact scenes, by kind."""
    make_colmap_scene(folder / "colmap", views=9)
    make_blender_scene(folder / "blender")
    return {"colmap": folder / "colmap", "blender": folder / "blender"}


def _sparse(scene: Path) -> Path:
    return scene / "sparse" / "0"


def _photo(scene: Path) -> Path:
    return scene / "images" / "left" / "v02.png"


def _as_text(scene: Path, file: str, change: Callable[[list[str]], list[str]]) -> None:
    """Convert the model to text and change the data lines of a file, split at blanks."""
    import pycolmap

    model = pycolmap.Reconstruction(_sparse(scene))
    for path in _sparse(scene).iterdir():
        path.unlink()
    model.write_text(str(_sparse(scene)))
    path = _sparse(scene) / file
    lines = path.read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if line and not line.startswith("#"))
    lines[first] = " ".join(change(lines[first].split()))
    path.write_text("\n".join(lines) + "\n")


def _cut(path: Path, count: int) -> None:
    path.write_bytes(path.read_bytes()[:-count])


def _replace_at(index: int, value: str) -> Callable[[list[str]], list[str]]:
    return lambda words: [*words[:index], value, *words[index + 1 :]]


def _transforms(scene: Path, change: Callable[[dict], object]) -> None:
    path = scene / "transforms_train.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def _cloud(scene: Path, properties: str, row: str) -> None:
    header = ["ply", "format ascii 1.0", "element vertex 1", *(f"property {p}" for p in properties.split(", "))]
    (_sparse(scene) / "points3D.ply").write_text("\n".join([*header, "end_header", row]) + "\n")


# The folder


@fault("colmap", "no -s given")
def _(scene: Path) -> Options:
    return {"source_path": ""}


@fault("colmap", "the folder given with -s does not exist")
def _(scene: Path) -> Options:
    return {"source_path": str(scene / "garden")}


@fault("colmap", "-s names a file")
def _(scene: Path) -> Options:
    return {"source_path": str(_sparse(scene) / "cameras.bin")}


@fault("colmap", "the folder is empty")
def _(scene: Path) -> None:
    shutil.rmtree(scene)
    scene.mkdir()


@fault("colmap", "photos only, nothing was reconstructed")
def _(scene: Path) -> None:
    shutil.rmtree(scene / "sparse")


@fault("colmap", "-s names the folder of the photos")
def _(scene: Path) -> Options:
    return {"source_path": str(scene / "images")}


@fault("colmap", "-s names the folder of the model")
def _(scene: Path) -> Options:
    return {"source_path": str(_sparse(scene))}


@fault("colmap", "-s names the folder around the scene")
def _(scene: Path) -> None:
    inner = scene / "garden"
    inner.mkdir()
    for name in ("images", "sparse"):
        (scene / name).rename(inner / name)


@fault("colmap", "the output folder lies in the scene")
def _(scene: Path) -> Options:
    return {"model_path": str(scene / "output")}


# The COLMAP model


@fault("colmap", "sparse/0 is empty")
def _(scene: Path) -> None:
    for path in _sparse(scene).iterdir():
        path.unlink()


@fault("colmap", "images.bin is missing")
def _(scene: Path) -> None:
    (_sparse(scene) / "images.bin").unlink()


@fault("colmap", "points3D.bin is missing")
def _(scene: Path) -> None:
    (_sparse(scene) / "points3D.bin").unlink()


@fault("colmap", "cameras.bin is cut short")
def _(scene: Path) -> None:
    _cut(_sparse(scene) / "cameras.bin", 5)


@fault("colmap", "images.bin is cut short")
def _(scene: Path) -> None:
    _cut(_sparse(scene) / "images.bin", 1000)


@fault("colmap", "points3D.bin is cut short")
def _(scene: Path) -> None:
    _cut(_sparse(scene) / "points3D.bin", 1000)


@fault("colmap", "cameras.bin is empty")
def _(scene: Path) -> None:
    (_sparse(scene) / "cameras.bin").write_bytes(b"")


@fault("colmap", "images.bin is an error page that was downloaded")
def _(scene: Path) -> None:
    (_sparse(scene) / "images.bin").write_text("<!DOCTYPE html><html><body>404 Not Found</body></html>")


@fault("colmap", "the model registers no photo")
def _(scene: Path) -> None:
    import pycolmap

    pycolmap.Reconstruction().write_binary(str(_sparse(scene)))


@fault("colmap", "a word where cameras.txt needs a number")
def _(scene: Path) -> None:
    _as_text(scene, "cameras.txt", _replace_at(4, "wide"))


@fault("colmap", "a camera model that COLMAP does not have")
def _(scene: Path) -> None:
    _as_text(scene, "cameras.txt", _replace_at(1, "PINHOLE2"))


@fault("colmap", "a spherical camera")
def _(scene: Path) -> None:
    _as_text(scene, "cameras.txt", lambda words: [words[0], "EQUIRECTANGULAR", *("96", "48") * 2])


@fault("colmap", "a focal length of zero")
def _(scene: Path) -> None:
    _as_text(scene, "cameras.txt", _replace_at(4, "0"))


@fault("colmap", "a principal point that is not a number")
def _(scene: Path) -> None:
    _as_text(scene, "cameras.txt", _replace_at(6, "nan"))


@fault("colmap", "a pose that is not finite")
def _(scene: Path) -> None:
    _as_text(scene, "images.txt", _replace_at(5, "nan"))


@fault("colmap", "a photo of a camera that is not in cameras.txt")
def _(scene: Path) -> None:
    _as_text(scene, "images.txt", _replace_at(8, "77"))


@fault("colmap", "a point that is not finite")
def _(scene: Path) -> None:
    _as_text(scene, "points3D.txt", _replace_at(2, "nan"))


# The photos


@fault("colmap", "the folder images is missing")
def _(scene: Path) -> None:
    shutil.rmtree(scene / "images")


@fault("colmap", "-i names a folder that is not there")
def _(scene: Path) -> Options:
    return {"images": "images_4"}


@fault("colmap", "one photo is missing")
def _(scene: Path) -> None:
    _photo(scene).unlink()


@fault("colmap", "the photos were converted to another format")
def _(scene: Path) -> None:
    for path in sorted((scene / "images").rglob("*.png")):
        Image.open(path).save(path.with_suffix(".jpg"))
        path.unlink()


@fault("colmap", "a photo is a link to nothing")
def _(scene: Path) -> None:
    _photo(scene).unlink()
    os.symlink(scene / "gone.png", _photo(scene))


@fault("colmap", "a photo is cut short")
def _(scene: Path) -> None:
    _cut(_photo(scene), 40)


@fault("colmap", "a photo is empty")
def _(scene: Path) -> None:
    _photo(scene).write_bytes(b"")


@fault("colmap", "a photo is a Git LFS pointer")
def _(scene: Path) -> None:
    _photo(scene).write_text("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n")


@fault("colmap", "a photo has floating-point pixels")
def _(scene: Path) -> None:
    Image.new("F", (96, 64), 0.5).save(_photo(scene), "TIFF")


@fault("colmap", "--eval with one photo")
def _(scene: Path) -> Options:
    shutil.rmtree(scene)
    make_colmap_scene(scene, views=1)
    return {"eval": True}


# The cloud


@fault("colmap", "--init_pcd_path names no file")
def _(scene: Path) -> Options:
    return {"init_pcd_path": str(scene / "dense.ply")}


@fault("colmap", "points3D.ply has no colours")
def _(scene: Path) -> None:
    _cloud(scene, "float x, float y, float z", "0 0 0")


@fault("colmap", "points3D.ply is cut short")
def _(scene: Path) -> None:
    _cloud(scene, "float x, float y, float z, uchar red, uchar green, uchar blue", "0 0")


@fault("colmap", "points3D.ply has floating-point colours up to 255")
def _(scene: Path) -> None:
    _cloud(scene, "float x, float y, float z, float red, float green, float blue", "0 0 0 255 128 0")


# Blender


@fault("blender", "transforms_test.json is missing")
def _(scene: Path) -> None:
    (scene / "transforms_test.json").unlink()


@fault("blender", "transforms_train.json is cut short")
def _(scene: Path) -> None:
    _cut(scene / "transforms_train.json", 30)


@fault("blender", "transforms_train.json has no camera_angle_x")
def _(scene: Path) -> None:
    _transforms(scene, lambda content: content.pop("camera_angle_x"))


@fault("blender", "camera_angle_x is in degrees")
def _(scene: Path) -> None:
    _transforms(scene, lambda content: content.update(camera_angle_x=40.0))


@fault("blender", "no frames are listed")
def _(scene: Path) -> None:
    for split in ("train", "test"):
        (scene / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": []}))


@fault("blender", "a transform_matrix has three rows")
def _(scene: Path) -> None:
    _transforms(scene, lambda content: content["frames"][1]["transform_matrix"].pop())


@fault("blender", "a transform_matrix can't be inverted")
def _(scene: Path) -> None:
    _transforms(scene, lambda content: content["frames"][1].update(transform_matrix=[[0.0] * 4] * 4))


@fault("blender", "a transform_matrix is mirrored")
def _(scene: Path) -> None:
    _transforms(scene, lambda content: content["frames"][1]["transform_matrix"].__setitem__(2, [0.0, -1.0, 0.0, 0.0]))


@fault("blender", "a transform_matrix is sheared")
def _(scene: Path) -> None:
    _transforms(scene, lambda content: content["frames"][1]["transform_matrix"][0].__setitem__(0, 1.5))


@fault("blender", "a frame has no file_path")
def _(scene: Path) -> None:
    _transforms(scene, lambda content: content["frames"][1].pop("file_path"))


@fault("blender", "the photo of a frame is missing")
def _(scene: Path) -> None:
    (scene / "train" / "r_1.png").unlink()
