"""The formats of files: those that export.py writes, by the ending of a name, and those that are read, by content."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from splatting.exports.ply import is_compressed_ply, read_compressed_ply, read_plain_ply
from splatting.exports.splats import Splats, tidy
from splatting.exports.spz import read_spz
from splatting.exports.web import read_splat
from splatting.files.ply_header import header_lines
from utils.system_utils import UserError

READABLE = "PLY, compressed PLY, SPZ or .splat"


@dataclass(frozen=True)
class Format:
    """A format. ending: of its files' names; where: module and function that writes it; what: for people.

    of_scene: its writer also takes what `write_scene_html` does. needs: function of the same module that finds the
    package or program without which nothing can be written.
    """

    ending: str
    where: tuple[str, str]
    what: str
    of_scene: bool = False
    needs: str | None = None

    def check(self, path: str | os.PathLike) -> None:
        """UserError if what a file of this name needs is not installed."""
        if self.needs:
            getattr(import_module(self.where[0]), self.needs)(path)

    def write(self, path: str | os.PathLike, splats: Splats, *of_scene: Any) -> None:
        """Write a file, whole or not at all. of_scene: further arguments of the writer. UserError as from it."""
        module, name = self.where
        writer: Callable[..., None] = getattr(import_module(module), name)  # only now, as each has its own packages
        writer(path, splats, *of_scene)


# An ending that ends with another one comes before it.
FORMATS = (
    Format(".compressed.ply", ("splatting.exports.ply", "write_compressed_ply"), "PlayCanvas, SuperSplat"),
    Format(".ply", ("splatting.exports.ply", "write_plain_ply"), "float32, everything kept"),
    Format(".splat", ("splatting.exports.web", "write_splat"), "antimatter15, 32 bytes a splat, no SH bands"),
    Format(".spz", ("splatting.exports.spz", "write_spz"), "Niantic, version 4", needs="find_zstandard"),
    Format(
        ".sog",
        ("splatting.exports.web", "write_sog"),
        "PlayCanvas, through splat-transform",
        needs="find_program",
    ),
    Format(".glb", ("splatting.exports.scene_formats", "write_glb"), "glTF with KHR_gaussian_splatting, float32"),
    Format(".usdz", ("splatting.exports.scene_formats", "write_usdz"), "OpenUSD, float32", needs="find_pxr"),
    Format(".html", ("splatting.exports.html", "write_scene_html"), "a page with a viewer", of_scene=True),
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
