"""Reading a file of splats, whose format is known by its content."""

import os
from pathlib import Path

import numpy as np

from groundwork.files.ply_header import header_lines
from scene.splats.dot_splat import read_splat
from scene.splats.ply import read_compressed_ply, read_plain_ply
from scene.splats.splats import Splats, tidy
from scene.splats.spz import read_spz
from scene.splats.trained import read_trained
from utils.system_utils import UserError

READABLE = "PLY, compressed PLY, SPZ, .splat, or a checkpoint"
CHECKPOINTS = (".pth", ".pt", ".ckpt")  # train.py's, gsplat's and nerfstudio's
_OTHERS = (".sog", ".ksplat", ".glb", ".gltf", ".usdz")  # models that other programs read
_SPZ = (b"NGSP", b"\x1f\x8b")  # how its files begin


def is_point_cloud(path: str | os.PathLike) -> bool:
    """Tell whether a file has points instead of splats: a PLY without their properties, or a file of another kind."""
    if not os.path.isfile(path) or Path(path).suffix.lower() in (".splat", ".spz", *CHECKPOINTS, *_OTHERS):
        return False
    names = _read_properties(path)
    if names is None:
        with open(path, "rb") as file:
            return not file.read(4).startswith(_SPZ)
    return not names & {"f_dc_0", "opacity", "scale_0", "rot_0", "packed_position"}


def _read_properties(path: str | os.PathLike) -> set[str] | None:
    """The names of a PLY's properties, without CloudCompare's prefix; None for another file."""
    lines = [line.split() for line in header_lines(path)]
    names = (words[-1] for words in lines if words[:1] == ["property"])
    return {name.removeprefix("scalar_") for name in names} if lines else None


@np.errstate(over="ignore", invalid="ignore")  # what float32 cannot hold becomes Inf or NaN, which is not drawn
def read_splats(path: str | os.PathLike) -> Splats:
    """The Gaussians of a file. UserError if it is missing, damaged, or of another format."""
    if os.path.isdir(path):
        raise UserError(
            f"{path} is a folder; give the file of a model in it, or where there is -m, a model folder by -m"
        )
    if not os.path.isfile(path):
        raise UserError(f"no file {path}; give a model as {READABLE}")
    try:
        with open(path, "rb") as file:
            begin = file.read(4)
    except OSError as error:
        raise UserError(f"cannot read {path} ({error.strerror}); fix its permissions") from error
    if (properties := _read_properties(path)) is not None:
        read = read_compressed_ply if "packed_position" in properties else read_plain_ply
    elif begin.startswith(_SPZ):
        read = read_spz
    elif Path(path).suffix.lower() == ".splat":  # it has no sign of its own
        read = read_splat
    elif Path(path).suffix.lower() in CHECKPOINTS:
        read = read_trained
    elif Path(path).suffix.lower() == ".sog":  # which export.py has another program read
        raise UserError(f"{path} is a SOG; give a PLY of it, by export.py {path} --to FILE.ply")
    else:
        raise UserError(f"{path} is no model that this program reads; give {READABLE}")
    return tidy(read(path))
