"""The formats of files that export.py writes, by the ending of a name."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from scene.splats.dot_splat import write_splat
from scene.splats.ply import write_compressed_ply, write_plain_ply
from scene.splats.spz import find_zstandard, write_spz
from splatting.exports.scene_formats import find_pxr, write_glb, write_usdz
from splatting.exports.sog import find_program, write_sog
from utils.system_utils import UserError


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
