"""The formats of files that export.py writes, by the ending of a name."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import quote

from applications.export.mesh_files import (
    check_obj_mesh,
    check_usdz_mesh,
    find_packages,
    turn_z_up,
    write_glb_mesh,
    write_obj_mesh,
    write_ply_mesh,
    write_usdz_mesh,
)
from applications.export.scene_formats import find_pxr, write_glb, write_usdz
from applications.export.sog import find_splat_transform, write_sog
from gaussian_renderer.camera_paths.poses import poses_of
from groundwork.files.ours import refuse_foreign
from scene.cameras import Camera
from scene.splats.dot_splat import write_splat
from scene.splats.ply import write_compressed_ply, write_plain_ply
from scene.splats.splats import Splats
from scene.splats.spz import find_zstandard, write_spz
from utils.system_utils import UserError

if TYPE_CHECKING:  # SciPy takes a while to import
    from applications.export.mesh import Mesh
    from gaussian_renderer.camera_paths.keyframes import TimedPath
    from gaussian_renderer.camera_paths.poses import Poses


class SceneInputs(NamedTuple):
    """Inputs of the formats of a scene besides its splats."""

    cameras: Sequence[Camera]  # the training views
    background: tuple[float, float, float]  # RGB in [0, 1]
    pipe: argparse.Namespace
    make_path: Callable[[Poses], TimedPath] | None = None  # of a page's animation
    voxel: float | None = None  # of a mesh, in the world's unit
    start: str | None = None  # of a page: the photo that it begins at
    title: str | None = None  # of a page
    notes: str | None = None  # of a page: a file
    walk: bool = False  # of a page: guests can walk
    upright: bool = False  # whether -y of all of these is up, so that a page need not find it
    metric: bool = False  # whether the unit is known to be a metre
    triangles: int | None = None  # of a mesh, at most
    made: dict[Any, Any] | None = None  # what other files of the same splats and options have made, by name

    def once(self, name: Any, make: Callable[..., Any], *given: Any) -> Any:
        """Make what several files need, for the first of them only."""
        made = {} if self.made is None else self.made
        if name not in made:
            made[name] = make(*given)
        return made[name]


@dataclass(frozen=True)
class Format:
    """A format of files.

    ending: of the files' names.
    what: for people.
    write: writes a file of splats, whole or not at all; returns a description of the file, None if it has splats.
        UserError if the file cannot be written.
    of_scene: `write` also takes `SceneInputs`.
    options: of export.py that are for this kind of files only.
    around: views from around a model do, where there is no scene.
    clean: the model is cleaned unless --raw is given.
    bands: the file keeps SH bands.
    in_order: the file keeps the order of rows.
    check: raises UserError if a package or program that the file needs is missing, or if a file of the user is in the
        way of one that is written beside it.
    """

    ending: str
    write: Callable[..., None]
    what: str
    of_scene: bool = False
    options: tuple[str, ...] = ()
    bands: bool = True
    around: bool = False
    clean: bool = False
    in_order: bool = False
    check: Callable[[str | os.PathLike], Any] = lambda path: None


def _preview_path(page: str | os.PathLike) -> Path:
    return Path(page).with_name(f"{Path(page).name}.jpg")  # no photo has such a name


def _write_html(path: str | os.PathLike, splats: Splats, around: SceneInputs) -> None:
    from applications.export.html import write_html  # SciPy and jinja2 take a while to import
    from applications.export.notes import read_notes
    from applications.export.page_start import find_named, write_preview
    from gaussian_renderer.camera_paths.start import best_start

    solid = None
    if around.walk:
        from applications.export.walking import make_solid, make_walkable

        splats, around = around.once("walkable", make_walkable, splats, around)
        solid = around.once("solid", make_solid, splats, around.cameras, around.pipe)
    notes = read_notes(around.notes) if around.notes else None
    names = [str(camera.image_name) for camera in around.cameras]
    if around.start is not None:
        start = find_named(around.start, names, f"--start {around.start}")
    elif notes and notes.views:
        start = find_named(notes.views[0].camera, names, f"--notes: {notes.views[0].camera}")
    else:
        start = best_start(poses_of(around.cameras)) if names else 0
    picture = _preview_path(path)
    how = around.make_path, around.background, around.title, start, quote(os.fsencode(picture.name))
    how = *how, around.upright, around.metric, notes, solid, around.pipe, around.once
    write_html(path, splats, around.cameras, *how)
    write_preview(picture, splats, around.cameras[start], around.pipe, around.background)


def _mesh_format(
    ending: str,
    write: Callable[[str | os.PathLike, Mesh, Splats], None],
    what: str,
    check: Callable[[str | os.PathLike], None] = find_packages,
    with_texture: bool = True,
) -> Format:
    """A format of meshes, with a texture or with colours of vertices."""

    def write_mesh(path: str | os.PathLike, splats: Splats, around: SceneInputs) -> str:
        from applications.export.mesh import make_mesh, measure_surfaces  # as does this

        measured = around.once("surfaces", measure_surfaces, splats, around.cameras, around.pipe, around.voxel)
        mesh, text = around.once(with_texture, make_mesh, *measured, around.triangles, with_texture)
        write(path, turn_z_up(mesh) if around.upright and not with_texture else mesh, splats)
        return text

    return Format(ending, write_mesh, what, True, ("voxel", "triangles"), bands=False, check=check)


def _write_tileset(path: str | os.PathLike, splats: Splats, around: SceneInputs, compressed: bool = False) -> str:
    from applications.export.tiles3d import write_tileset  # as it imports the rasterizer

    return write_tileset(path, splats, around, compressed)


def _write_lod_meta(path: str | os.PathLike, splats: Splats, around: SceneInputs) -> str:
    from applications.export.streamed import write_lod_meta  # as it imports the rasterizer, too

    return write_lod_meta(path, splats, around)


# An ending that ends with another one comes before it.
FORMATS = (
    _mesh_format("mesh.ply", write_ply_mesh, "surfaces, as coloured triangles", with_texture=False),
    _mesh_format("mesh.glb", write_glb_mesh, "surfaces with a texture, as glTF"),
    _mesh_format("mesh.obj", write_obj_mesh, "the same, with .mtl and .png beside it", check_obj_mesh),
    _mesh_format("mesh.usdz", write_usdz_mesh, "the same, as OpenUSD", check_usdz_mesh),
    Format(".compressed.ply", write_compressed_ply, "PlayCanvas, SuperSplat"),
    Format(".ply", write_plain_ply, "Gaussians in float32, everything kept", in_order=True),
    Format(".splat", write_splat, "antimatter15, 32 bytes a splat, no SH bands", bands=False),
    Format(".spz", write_spz, "Niantic, version 4, or 3 or 2", options=("spz_version",), check=find_zstandard),
    Format(".sog", write_sog, "PlayCanvas, through splat-transform", check=find_splat_transform),
    Format(".glb", write_glb, "glTF with KHR_gaussian_splatting, float32", in_order=True),
    Format(
        "cesium.json", partial(_write_tileset, compressed=True), "3D Tiles for CesiumJS, as SPZ 2", True, around=True
    ),
    Format("tileset.json", _write_tileset, "3D Tiles of such GLB, by levels of detail", of_scene=True, around=True),
    Format(
        "lod-meta.json",
        _write_lod_meta,
        "streamed SOG, by the same levels",
        of_scene=True,
        around=True,
        check=find_splat_transform,
    ),
    Format(".usdz", write_usdz, "OpenUSD, float32", in_order=True, check=find_pxr),
    Format(
        ".html",
        _write_html,
        "a page with a viewer",
        True,
        ("path", "start", "title", "notes", "walk", "raw"),
        around=True,
        clean=True,
        check=lambda path: refuse_foreign(_preview_path(path)),
    ),
)

ENDINGS = ", ".join(f"{entry.ending} ({entry.what})" for entry in FORMATS)


def find_format(path: str | os.PathLike) -> Format:
    """The format of a file's name. UserError for an ending that is none of the table's."""
    name = os.fspath(path).lower()
    for entry in FORMATS:
        if name.endswith(entry.ending):
            return entry
    raise UserError(f"the format of {path} is unknown; end its name with one of {ENDINGS}")
