"""The formats of files: those that export.py writes, by the ending of a name, and those that are read, by content."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatting.exports.ply import read_compressed_ply, read_plain_ply, write_compressed_ply, write_plain_ply
from splatting.exports.scene_formats import find_pxr, write_glb, write_usdz
from splatting.exports.splats import Splats, tidy
from splatting.exports.spz import find_zstandard, read_spz, write_spz
from splatting.exports.web import find_program, read_splat, write_sog, write_splat
from splatting.files.ply_header import header_lines
from utils.system_utils import UserError

READABLE = "PLY, compressed PLY, SPZ or .splat"
_SPZ = (b"NGSP", b"\x1f\x8b")  # how its files begin


@dataclass(frozen=True)
class Format:
    """A format. ending: of its files' names; what: for people.

    write: writes a file of splats, whole or not at all. UserError if it cannot be written. of_scene: it also takes the
    further arguments of `write_html`. bands: it keeps SH bands. check: raises UserError if a package or program that
    the file needs is missing.
    """

    ending: str
    write: Callable[..., None]
    what: str
    of_scene: bool = False
    bands: bool = True
    check: Callable[[str | os.PathLike], Any] = lambda path: None


def _write_html(*arguments: Any) -> None:
    from splatting.exports.html import write_html  # SciPy and jinja2 take a while to import

    write_html(*arguments)


# An ending that ends with another one comes before it.
FORMATS = (
    Format(".compressed.ply", write_compressed_ply, "PlayCanvas, SuperSplat"),
    Format(".ply", write_plain_ply, "float32, everything kept"),
    Format(".splat", write_splat, "antimatter15, 32 bytes a splat, no SH bands", bands=False),
    Format(".spz", write_spz, "Niantic, version 4", check=find_zstandard),
    Format(".sog", write_sog, "PlayCanvas, through splat-transform", check=find_program),
    Format(".glb", write_glb, "glTF with KHR_gaussian_splatting, float32"),
    Format(".usdz", write_usdz, "OpenUSD, float32", check=find_pxr),
    Format(".html", _write_html, "a page with a viewer", of_scene=True),
)


def format_of(path: str | os.PathLike) -> Format:
    """The format of a file's name. UserError for an ending that is none of the table's."""
    name = os.fspath(path).lower()
    for entry in FORMATS:
        if name.endswith(entry.ending):
            return entry
    endings = ", ".join(entry.ending for entry in FORMATS)
    raise UserError(f"the format of {path} is unknown; end its name with one of {endings}")


def is_point_cloud(path: str | os.PathLike) -> bool:
    """Whether a file has points instead of splats: a PLY without their properties, or a file of another kind."""
    if not os.path.isfile(path) or Path(path).suffix.lower() in (".splat", ".spz"):
        return False
    names = _properties(path)
    if names is None:
        with open(path, "rb") as file:
            return not file.read(4).startswith(_SPZ)
    return not names & {"f_dc_0", "opacity", "scale_0", "rot_0", "packed_position"}


def _properties(path: str | os.PathLike) -> set[str] | None:
    """The names of a PLY's properties, without CloudCompare's prefix; None for another file."""
    lines = [line.split() for line in header_lines(path)]
    names = (words[-1] for words in lines if words[:1] == ["property"])
    return {name.removeprefix("scalar_") for name in names} if lines else None


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
    if (properties := _properties(path)) is not None:
        read = read_compressed_ply if "packed_position" in properties else read_plain_ply
    elif begin.startswith(_SPZ):
        read = read_spz
    elif Path(path).suffix.lower() == ".splat":  # it has no sign of its own
        read = read_splat
    else:
        raise UserError(f"{path} is no model that this program reads; give {READABLE}")
    return tidy(read(path))
