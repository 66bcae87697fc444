"""A model as one HTML file, with a viewer: it opens from disk, without network and without other programs."""

import base64
import gzip
import io
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import jinja2
import numpy as np

from scene.cameras import Camera
from scene.scene import Scene
from splatting.camera_paths.moments import TimedPath
from splatting.camera_paths.poses import Poses, poses_of
from splatting.exports.ply import packed_ply
from splatting.exports.splats import Splats
from splatting.exports.vendor import FOLDER, RECORD, VIEWER
from splatting.exports.viewer_world import settings, turn_upright, turned, up_of
from splatting.files.json_files import read_json
from utils.system_utils import UserError, atomic_write

LONGEST = 500_000_000  # letters of a page's text; Chromium's strings end at 2^29
_NAME = "scene.compressed.ply"  # its ending tells the viewer the format


def write_html(
    path: str | os.PathLike,
    splats: Splats,
    cameras: Sequence[Camera],
    camera_path: TimedPath | None = None,
    title: str | None = None,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> None:
    """Write the page, whole or not at all.

    cameras: the training views, the first of which is where the page begins; up to 25 of them become bookmarks.
    camera_path: the animation, None: the viewer's own, which goes around the model, or sways where the first camera is
    in the model's box. title: None: the file's name. background: RGB in [0,1].
    UserError without a camera.
    """
    if not cameras:
        raise UserError("a page needs at least one training camera, from which it shows the model; the scene has none")
    poses = poses_of(cameras)
    turn = turn_upright(up_of(poses))
    names = [str(camera.image_name) for camera in cameras]
    # The median distance of the Gaussians from the first camera.
    distance = float(np.median(np.linalg.norm(splats.means - poses.positions[0], axis=1))) if len(splats) else 1.0
    page = {
        "antialiasing": splats.antialiasing,
        "name": _NAME,
        "settings": settings(poses, names, turn, camera_path, background, distance),
    }
    content = _template().render(
        background=", ".join(f"{255 * value:.0f}" for value in background),
        css=(FOLDER / "viewer.css").read_text(encoding="utf-8"),
        licence=(FOLDER / "LICENSE").read_text(encoding="utf-8"),
        model=_packed_model(turned(splats, turn)),
        # No text in the JSON may end the script element that it stands in.
        page=json.dumps(page, allow_nan=False).replace("<", "\\u003c"),
        record=read_json(RECORD),
        title=Path(path).stem if title is None else title,
        viewer=_in_base64((FOLDER / VIEWER).read_bytes()),
    )
    with atomic_write(path) as temporary:
        # Names that are not UTF-8 have surrogates, which appear as numbers.
        temporary.write_text(content, encoding="utf-8", errors="backslashreplace")


def write_scene_html(
    path: str | os.PathLike,
    splats: Splats,
    scene: Scene,
    white_background: bool = False,
    make_path: Callable[[Poses], TimedPath] | None = None,
) -> None:
    """Write the page of splats from a scene's model, with its training views, as `write_html` does.

    white_background: whether it was trained with -w. make_path: the animation from the training views' poses, as of
    splatting/camera_paths/request.py.
    """
    cameras = scene.getTrainCameras()
    camera_path = make_path(poses_of(cameras)) if make_path and cameras else None
    background = (1.0, 1.0, 1.0) if white_background else (0.0, 0.0, 0.0)
    write_html(path, splats, cameras, camera_path, background=background)


def _template() -> jinja2.Template:
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template("page.html.jinja")


def _in_base64(content: bytes) -> str:
    return base64.b64encode(content).decode()


def _packed_model(splats: Splats) -> str:
    content = io.BytesIO()
    packed_ply(splats).write(content)
    packed = _in_base64(gzip.compress(content.getbuffer(), mtime=0))
    if len(packed) > LONGEST:
        raise UserError(
            f"a page of {len(splats):,} Gaussians of SH degree {splats.sh_degree} would have {len(packed) / 1e6:.0f} "
            f"MB, and browsers read at most {LONGEST / 1e6:.0f}; export fewer by --max_splats or --sh_degree"
        )
    return packed
