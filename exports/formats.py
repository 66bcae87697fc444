"""Table of the formats that export.py writes, by the ending of the file's name."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from exports.splats import Splats
from utils.system_utils import UserError


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
    Format(".compressed.ply", ("exports.compressed_ply", "write_compressed_ply"), "PlayCanvas, SuperSplat"),
    Format(".ply", ("exports.plain_ply", "write_plain_ply"), "float32, everything kept"),
    Format(".splat", ("exports.splat", "write_splat"), "antimatter15, 32 bytes a splat, no SH bands"),
    Format(".spz", ("exports.spz", "write_spz"), "Niantic, version 4", needs="find_zstandard"),
    Format(".sog", ("exports.sog", "write_sog"), "PlayCanvas, through splat-transform", needs="find_program"),
    Format(".glb", ("exports.glb", "write_glb"), "glTF with KHR_gaussian_splatting, float32"),
    Format(".usdz", ("exports.usdz", "write_usdz"), "OpenUSD, float32", needs="find_pxr"),
    Format(".html", ("exports.html", "write_scene_html"), "a page with a viewer", of_scene=True),
)


def format_of(path: str | os.PathLike) -> Format:
    """The format of a file's name. UserError for an ending that is none of the table's."""
    name = os.fspath(path).lower()
    for entry in FORMATS:
        if name.endswith(entry.ending):
            return entry
    endings = ", ".join(entry.ending for entry in FORMATS)
    raise UserError(f"the format of {path} is unknown; end its name with one of {endings}")
