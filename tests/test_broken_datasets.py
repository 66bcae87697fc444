"""Scenes with one fault each: every fault gets a message of one sentence that a user can act on, and no output."""

import argparse
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image
from synthetic import FOCAL, as_text, edit_json, make_blender_scene, make_colmap_scene, make_nerfstudio_scene

from arguments import ModelParams
from scene import Scene
from scene.checks.scene import check_scene
from scene.gaussian_model import GaussianModel
from utils.system_utils import UserError

Change = Callable[[Path], object]  # changes a scene, and may return options of train.py
SPARSE, PHOTO = "sparse/0", "images/left/v02.png"
SMALL = (4, "0"), (5, "1"), (6, "0.25")  # a colour
XYZ, RGB = "float x, float y, float z", "uchar red, uchar green, uchar blue"


def _gone(name: str) -> Change:
    def change(scene: Path) -> None:
        path = scene / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return change


def _written(name: str, content: bytes | str) -> Change:
    return lambda scene: (scene / name).write_bytes(content if isinstance(content, bytes) else content.encode()) and {}


def _cut(name: str, count: int) -> Change:
    return lambda scene: _written(name, (scene / name).read_bytes()[:-count])(scene)


def _given(**options: str) -> Change:
    """Options, with the scene folder for SCENE."""
    return lambda scene: {name: value.replace("SCENE", str(scene)) for name, value in options.items()}


def _lines(file: str, edit: Callable[[list[str]], list[str]]) -> Change:
    """The lines of a text file are edited, of which comments are left out."""

    def change(scene: Path) -> None:
        as_text(scene)
        path = scene / SPARSE / file
        lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
        path.write_text("\n".join([*edit(lines), ""]))

    return change


def _replaced(line: str, places: tuple[tuple[int, str], ...]) -> str:
    words = line.split()
    for place, word in places:
        words[place] = word
    return " ".join(words)


def _word(file: str, *places: tuple[int, str]) -> Change:
    """Words of the first line of a text file are replaced; a place at the end ends the line."""
    return _lines(file, lambda lines: [_replaced(lines[0], places), *lines[1:]])


def _twice(file: str, number: int, *places: tuple[int, str]) -> Change:
    """A record of a text file again, with other words, behind the first `number` lines."""
    more = slice(1, 2 if file == "images.txt" else 1)
    return _lines(file, lambda lines: [*lines[:number], _replaced(lines[0], places), *lines[more], *lines[number:]])


def _cloud(name: str, properties: str, rows: str, element: str = "vertex 1", kind: str = "ascii") -> Change:
    header = [f"ply\nformat {kind} 1.0\nelement {element}", *(f"property {p}" for p in properties.split(", "))]
    return _written(name, "\n".join([*header, "end_header", rows]) + "\n")


def _own(*cloud: object, **more: object) -> Change:
    return _cloud(f"{SPARSE}/points3D.ply", *cloud, **more)


def _mine(*cloud: object, **more: object) -> Change:
    """A cloud in a file that --init_pcd_path names."""

    def change(scene: Path) -> dict[str, str]:
        _cloud("mine.ply", *cloud, **more)(scene)
        return {"init_pcd_path": str(scene / "mine.ply")}

    return change


def _json(edit: Callable[[dict], object]) -> Change:
    """A change of the camera file."""

    def change(scene: Path) -> None:
        path = next(scene / name for name in ("transforms_train.json", "transforms.json") if (scene / name).is_file())
        edit_json(path, edit)

    return change


def _with(**changes: object) -> Change:
    return _json(lambda content: content.update(changes))


def _frame(**changes: object) -> Change:
    return _json(lambda content: content["frames"][0].update(changes))


def _lacking(key: str) -> Change:
    return _json(lambda content: content["frames"][1].pop(key))


def _pose(row: int, values: list[float]) -> Change:
    matrix = np.diag([1.0, 1, 1, 1])
    matrix[2, 3], matrix[row] = 4, values
    return _frame(transform_matrix=matrix.tolist())


def _moved(scene: Path) -> None:
    (scene / "garden").mkdir()
    for name in ("images", "sparse"):
        (scene / name).rename(scene / "garden" / name)


def _emptied(scene: Path) -> None:
    shutil.rmtree(scene)
    scene.mkdir()


def _model(scene: Path) -> None:
    _emptied(scene)
    (scene / "cfg_args").touch()


def _no_model(scene: Path) -> None:
    for path in (scene / SPARSE).iterdir():
        path.unlink()


def _floats(scene: Path) -> None:
    Image.new("F", (96, 64), 0.5).save(scene / PHOTO, "TIFF")


def _no_views(scene: Path) -> None:
    pycolmap.Reconstruction().write_binary(str(scene / SPARSE))


def _seven_gone(scene: Path) -> None:
    for path in sorted((scene / "images").rglob("*.png"))[:7]:
        path.unlink()


def _converted(scene: Path) -> None:
    for path in sorted((scene / "images").rglob("*.png")):
        for suffix in (".jpg", ".bmp"):  # which of them is the photo, nobody knows
            Image.open(path).save(path.with_suffix(suffix))
        path.unlink()


def _one_photo(scene: Path) -> dict[str, bool]:
    shutil.rmtree(scene)
    make_colmap_scene(scene, views=1)
    return {"eval": True}


def _no_frames(scene: Path) -> None:
    for split in ("train", "test"):
        (scene / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": []}))


# The kind of scene, its fault, and the pattern of the message: the file or value, and what is wrong with it.
FAULTS: dict[str, list[tuple[Change, str]]] = {
    "colmap": [
        (_given(source_path=""), "no scene folder given; name it with -s"),
        (_given(source_path="SCENE/garden"), "no scene folder SCENE/garden"),
        (_given(source_path=f"SCENE/{SPARSE}/cameras.bin"), r"cameras\.bin is a file; give -s .*, SCENE$"),
        (_given(source_path="SCENE/images"), "images is not a scene: .*found Right, left; give -s SCENE, which is a"),
        (_given(init_pcd_path="SCENE/dense.ply"), "no point cloud SCENE/dense.ply"),
        (_emptied, "SCENE is not a scene: .*found nothing"),
        (_model, "SCENE is not a scene: .*found cfg_args; it is a model that train.py wrote: give it as -m"),
        (_moved, "not a scene: .*found garden; give -s a scene in it: SCENE/garden$"),
        (_gone("sparse"), r"looked for the folder sparse .*images;.* run \S*python\S* convert.py -s SCENE first$"),
        (_gone("images"), "there is no folder SCENE/images,.*-i"),
        (_no_model, "no COLMAP model.*found sparse/0;"),
        (_gone(f"{SPARSE}/images.bin"), "^SCENE/sparse/0 has no images as .bin or .txt; copy the"),
        (_cut(f"{SPARSE}/cameras.bin", 5), "0/cameras.bin ends within camera 1 of 1, or is no such file; copy the"),
        (_written(f"{SPARSE}/images.bin", "<!DOCTYPE html><html>404</html>"), "0/images.bin is a web page"),
        (_no_views, "COLMAP model in SCENE/sparse/0 has no registered photo"),
        (_word("cameras.txt", (4, "wide")), r"line 1 of SCENE/sparse/0/cameras\.txt .*wide"),
        (_word("cameras.txt", (1, "PINHOLE2")), r"line 1 of .*0/cameras\.txt .*no camera model PINHOLE2"),
        (
            _word("cameras.txt", (1, "EQUIRECTANGULAR"), (4, "96"), (5, "64"), (6, ""), (7, "")),
            "V03.png is a panorama, which no pinhole image can show; train on it with --lenses native",
        ),
        (_word("images.txt", (5, "nan")), "pose of .*png is not finite"),
        (_word("images.txt", (5, "1e30")), "more than 1e[+]12 from the origin"),
        (_word("images.txt", (8, "77")), r"SCENE/sparse/0/images\.txt has the camera 77"),
        (_word("points3D.txt", (2, "nan")), r"line 1 of SCENE/sparse/0/points3D\.txt .*nan"),
        (_twice("cameras.txt", 1), "^line 1 and line 2 of .*cameras.txt both have the id 1; keep one"),
        (_twice("images.txt", 4, (0, "999")), r"^line 1 and line 5 of .*images\.txt both have the name left/v08.png"),
        (_twice("points3D.txt", 3), r"^line 1 and line 4 of .*points3D\.txt both have the id 1;"),
        (
            _lines("points3D.txt", lambda lines: [_replaced(line, SMALL) for line in lines]),
            r"^line 1 of .*points3D\.txt has the colour 0.0 1.0 0.25, but COLMAP's colours range from 0 to 255;",
        ),
        (
            _lines("images.txt", lambda lines: [line.replace("left/v02.png", "left/./V04.png") for line in lines]),
            r"left/\./V04.png and left/v04.png in .* are one file, .*; rename one",
        ),
        (_gone(PHOTO), "1 of 9 photos .*are missing: SCENE/images/left/v02.png"),
        (_seven_gone, r"7 of 9 photos that .* lists are missing: .*Right/V03.png, .* and 2 more \(the folder has .*-i"),
        (_converted, r"9 of 9 photos .*Right/V03.png.*the folder has Right/V03.bmp, .*go on without.*image_deleter"),
        (_cut(PHOTO, 40), "cannot read SCENE/images/left/v02.png .*truncated"),
        (_written(PHOTO, b""), "SCENE/images/left/v02.png is empty"),
        (_written(PHOTO, "version https://git-lfs.github.com/spec/v1\noid sha256:4\n"), "left/v02.png .*git lfs pull"),
        (_floats, "cannot read .*v02.png .*floating-point"),
        (_one_photo, "SCENE has too few photos for --eval"),
        (_own(f"{XYZ}, uchar red, uchar green", "0 0 0 1 1"), "points3D.ply has red but no blue"),
        (_own(f"{XYZ}, {RGB.replace('uchar', 'float')}", "0 0 0 256 128 0"), "colours in .*points3D.ply are neither"),
        (_mine("float x", "", element="face 0"), "has no x, y, z; it needs"),
        (_mine(f"{XYZ}, {RGB}", "0 0 0 1 1 1\n0 nan 0 1 1 1", "vertex 2"), r"1 of 2 .* finite \(first: number 1\)"),
        (_mine(f"list uchar {XYZ}, {RGB}", "2 1 1 0 0 1 1 1"), "lists instead of numbers"),
        (_mine(f"{XYZ}, {RGB}", "short", "vertex 9", kind="binary_little_endian"), "not a readable PLY"),
    ],
    "blender": [
        (_gone("train/r_2.png"), "1 of 4 photos that .*transforms_train.json lists are missing: SCENE/train/r_2.png"),
        (_cut("transforms_train.json", 30), "SCENE/transforms_train.json is not a camera file .JSONDecodeError"),
        (_written("transforms_train.json", "[" * 100_000), "transforms_train.json is not a camera file"),
        (_json(lambda content: content.pop("camera_angle_x")), "has neither camera_angle_x nor fl_x"),
        (_with(camera_angle_x=40.0), "camera_angle_x in .*between 0 and pi, got 40.0; .*radians"),
        (_with(cx=1e30), "principal point far outside"),
        (_no_frames, "SCENE/transforms_train.json lists no frames"),
        (_frame(file_path="a" * 5000), "1 of 4 photos"),
        (_lacking("file_path"), r"^frame 2 of SCENE/transforms_train\.json has no file_path"),
        (_frame(transform_matrix=[[1, 2], [3, 4]]), r"^frame 1 \(./train/r_0\) of .* must be 4x4 .*got shape"),
        (_frame(transform_matrix=[[0] * 4] * 4), r"^frame 1 \(./train/r_0\) of SCENE/.*Singular matrix"),
        (_pose(3, [1, 2, 3, 4]), "the last row of transform_matrix must be 0 0 0 1"),
        (_pose(0, [1, 0, 0, 1e30]), "camera of r_0 is more than 1e[+]12 from the origin"),
        (_pose(1, [0, 9, 0, 0]), "pose of r_0 has no valid rotation: its matrix scales by 0.1111 to 1;"),
        (_pose(1, [0, -1, 0, 0]), "pose of r_0 is mirrored"),
    ],
    "nerfstudio": [
        (_with(camera_model="SPHERICAL"), "camera_model SPHERICAL in .*cannot be used, only PINHOLE"),
        (_with(k1=0.1, k4=0.1), "has k4, k5 or k6 for the camera_model PERSPECTIVE"),
        (_with(fl_x="wide"), "is not a camera file .*could not convert"),
        (_with(fl_x=0), "camera of images/.* has no usable size or focal length"),
        (_with(frames=[]), "lists no frames"),
        (_json(lambda content: content.pop("frames")), "is not a camera file .*KeyError: 'frames'"),
    ],
}
# In units of the photo's size these are damaged files, not lenses.
for name, further in (("PINHOLE", ""), ("OPENCV", " 0.1 0 0 0")):
    for params in (
        (FOCAL, FOCAL, -1e20, 34),
        (FOCAL, 5e-324, 45, 34),
    ):
        places = (1, name), (4, " ".join(map(repr, params)) + further), (5, ""), (6, ""), (7, "")
        FAULTS["colmap"].append((_word("cameras.txt", *places), "camera of Right/V03.png has no usable size or focal"))


# Distortions that fold the photo, or that no lens has.
for name, further in (
    ("OPENCV", "-9 0 0 0"),
    ("OPENCV", "nan 0 0 0"),
    ("OPENCV_FISHEYE", "-9 0 0 0"),
    ("THIN_PRISM_FISHEYE", "0 0 0 0 0 0 1e3 0"),
):
    places = (1, name), (4, f"{FOCAL} {FOCAL} 45 34 {further}"), (5, ""), (6, ""), (7, "")
    said = "camera of Right/V03.png " + ("has no usable size" if "nan" in further else "folds its photo or changes")
    FAULTS["colmap"].append((_word("cameras.txt", *places), said))


@pytest.fixture(scope="module")
def masters(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The intact scenes, by kind."""
    folder = tmp_path_factory.mktemp("masters")
    make_colmap_scene(folder / "colmap", views=9)
    make_blender_scene(folder / "blender")
    make_nerfstudio_scene(folder / "nerfstudio", views=9)
    shutil.rmtree(folder / "nerfstudio" / "sparse")
    return {kind: folder / kind for kind in FAULTS}


def _train(scene: Path, out: Path, change: Change) -> None:
    """Do with a changed scene what a training does up to the first iteration."""
    options = {"source_path": str(scene), "model_path": str(out), "eval": scene.name == "blender"}
    extracted = ModelParams(argparse.ArgumentParser()).extract(argparse.Namespace(**options | (change(scene) or {})))
    taken = Scene(extracted, GaussianModel(3), start=False)
    check_scene(taken, extracted, False)
    taken.create_gaussians()
    for camera in taken.getTrainCameras():
        camera.target(torch.zeros(3))


ALL = [
    pytest.param(kind, change, said, id=f"{kind}-{said[:40]}") for kind, rows in FAULTS.items() for change, said in rows
]


@pytest.mark.parametrize(("kind", "change", "said"), ALL)
def test_one_sentence_that_names_the_thing_and_the_remedy(kind, change, said, masters, tmp_path):
    scene, out = Path(shutil.copytree(masters[kind], tmp_path / kind)), tmp_path / "out"
    with pytest.raises(UserError) as error:
        _train(scene, out, change)
    text = str(error.value).replace(str(scene), "SCENE").replace(str(out), "OUT")
    assert "\n" not in text and "Traceback" not in text and not out.exists()
    assert re.search(said, text), text
    # The remedy follows the semicolon.
    what, semicolon, remedy = text.rpartition("; ")
    assert semicolon and len(what) > 15 and len(remedy.split()) >= 3, text


def test_a_sound_scene_is_taken(masters, tmp_path):
    for kind in masters:
        _train(Path(shutil.copytree(masters[kind], tmp_path / kind)), tmp_path / "out", lambda scene: None)
    part_of_a_large_photo = _word("cameras.txt", (4, "500000 500000 -900 34.5"), (5, ""), (6, ""), (7, ""))
    _train(Path(shutil.copytree(masters["colmap"], tmp_path / "part")), tmp_path / "out", part_of_a_large_photo)
