"""Reading of splats from files of any tool, whose content decides the format."""

import os
from pathlib import Path

from exports.compressed_ply import is_compressed_ply, read_compressed_ply
from exports.plain_ply import read_plain_ply
from exports.selection import tidy
from exports.splat import read_splat
from exports.splats import Splats
from exports.spz import read_spz
from utils.system_utils import UserError

READABLE = "PLY, compressed PLY, SPZ or .splat"


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
