"""Reading of splats from files of any tool, whose content decides the format."""

import os
from pathlib import Path

import numpy as np

from exports.compressed_ply import is_compressed_ply, read_compressed_ply
from exports.plain_ply import read_plain_ply
from exports.selection import tidy
from exports.splat import read_splat
from exports.splats import Splats
from exports.spz import read_spz
from utils.files.ply_header import header_lines
from utils.system_utils import UserError

READABLE = "PLY, compressed PLY, SPZ or .splat"


def is_point_cloud(path: str | os.PathLike) -> bool:
    """Whether a file has points instead of splats: a PLY without their properties, or a file of another kind."""
    if not os.path.isfile(path) or Path(path).suffix.lower() in (".splat", ".spz"):
        return False
    lines = header_lines(path)
    if not lines:
        with open(path, "rb") as file:
            return not file.read(4).startswith((b"NGSP", b"\x1f\x8b"))
    names = {words[-1] for words in map(str.split, lines) if words[:1] == ["property"]}
    return not names & {"f_dc_0", "opacity", "scale_0", "rot_0", "packed_position"}


@np.errstate(over="ignore", invalid="ignore")  # what float32 cannot hold becomes Inf or NaN, which is not drawn
def read_splats(path: str | os.PathLike) -> Splats:
    """The Gaussians of a file. UserError if it is missing, damaged, or of another format."""
    if not os.path.isfile(path):
        raise UserError(f"no file {path}; give a model as {READABLE}")
    try:
        with open(path, "rb") as file:
            begin = file.read(4)
    except OSError as error:
        raise UserError(f"cannot read {path} ({error.strerror}); fix its permissions") from error
    if begin.startswith(b"ply"):
        return tidy(read_compressed_ply(path) if is_compressed_ply(path) else read_plain_ply(path))
    if begin == b"NGSP" or begin.startswith(b"\x1f\x8b"):
        return tidy(read_spz(path))
    if Path(path).suffix.lower() == ".splat":  # it has no sign of its own
        return tidy(read_splat(path))
    raise UserError(f"{path} is no model that this program reads; give {READABLE}")
