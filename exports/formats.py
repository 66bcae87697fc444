"""Table of the formats that export.py writes, by the ending of the file's name."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec

from exports.splats import Splats
from scene.cameras import Camera
from utils.system_utils import UserError


@dataclass(frozen=True)
class Format:
    """A format. ending: of its files' names; where: module and function that writes it; what: for people.

    wants_cameras: its writer takes the training views as a third argument.
    """

    ending: str
    where: tuple[str, str]
    what: str
    wants_cameras: bool = False

    def write(self, path: str | os.PathLike, splats: Splats, cameras: Sequence[Camera] = ()) -> None:
        """Write a file, whole or not at all. UserError as from its writer."""
        module, name = self.where
        writer: Callable[..., None] = getattr(import_module(module), name)  # only now, as each has its own packages
        writer(path, splats, *([cameras] if self.wants_cameras else []))


# An ending that ends with another one comes before it.
FORMATS = tuple(
    entry
    for entry in (
        Format(".compressed.ply", ("exports.compressed_ply", "write_compressed_ply"), "PlayCanvas, SuperSplat"),
        Format(".ply", ("exports.plain_ply", "write_plain_ply"), "float32, everything kept"),
        Format(".splat", ("exports.splat", "write_splat"), "antimatter15, 32 bytes a splat, no SH bands"),
        Format(".spz", ("exports.spz", "write_spz"), "Niantic, version 4"),
        Format(".sog", ("exports.sog", "write_sog"), "PlayCanvas, through splat-transform"),
        Format(".glb", ("exports.glb", "write_glb"), "glTF with KHR_gaussian_splatting, float32"),
        Format(".usdz", ("exports.usdz", "write_usdz"), "OpenUSD, float32"),
        Format(".html", ("exports.html", "write_html"), "a page with a viewer", wants_cameras=True),
    )
    if find_spec(entry.where[0])
)


def format_of(path: str | os.PathLike) -> Format:
    """The format of a file's name. UserError for an ending that is none of the table's."""
    name = os.fspath(path).lower()
    for entry in FORMATS:
        if name.endswith(entry.ending):
            return entry
    endings = ", ".join(entry.ending for entry in FORMATS)
    raise UserError(f"the format of {path} is unknown; end its name with one of {endings}")
