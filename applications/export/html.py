"""A model as one HTML file, with a viewer: it opens from disk, without network and without other programs.

The viewer's axes are x right, y up, z backwards, and its camera has no roll, so the model is turned upright. The form
of its settings is that of its settings.json, version 2 (docs/api.md and dist/settings.d.ts of the npm package).
"""

import argparse
import base64
import gzip
import io
import json
import os
import struct
import zlib
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2
import numpy as np
from scipy.spatial.transform import Rotation

from applications.export.notes import Note, Notes
from applications.export.page_start import find_named
from applications.export.vendor import FOLDER, RECORD, VIEWER
from gaussian_renderer.camera_paths.keyframes import TimedPath
from gaussian_renderer.camera_paths.poses import Poses, focus_point, keyframe, look_along, poses_of, ray_through, unit
from gaussian_renderer.free_view import free_view
from gaussian_renderer.median_depth import median_at
from groundwork.files.json_files import read_json
from groundwork.host.progress import in_threads
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from scene.splats.ply import packed_ply
from scene.splats.splats import Splats, rotated
from scene.with_splats import model_of
from utils.system_utils import UserError, atomic_write

if TYPE_CHECKING:
    from applications.export.walking import Solid

LONGEST = 500_000_000  # letters of a page's text; Chromium's strings end at 2^29
_PIECE, _WINDOW, _SHOWN = 1 << 20, 1 << 15, 64  # of compression: bytes, bytes; pieces that show a bar
_NAME = "scene.compressed.ply"  # its ending tells the viewer the format
UP = np.array([0.0, -1.0, 0.0])  # of the turned model, as in a usual capture
_MEAN_UP = 0.01  # weight of the mean up beside the cameras' horizons
BOOKMARKS = 10  # where no notes say which
_TITLE = 60  # letters of their titles, as the viewer has it
_ASIDE, _UNDER = 0.5, 0.25  # of the usual depth, by which visitors may leave the cameras' box, sideways and down
_USUAL_DEPTH = 2.0  # metres from a camera to what it looks at, where nothing tells the scale
SOLID = "model:/solid.voxel.json"  # where the viewer asks for what is solid; page.js answers
_KEYS_A_SECOND = 10
_MOST_KEYS = 1000
_VIEWER_AXES = np.diag([-1.0, -1.0, 1.0])  # the viewer turns each model by half a turn about z
_TEXTS = {"css": "viewer.css", "licence": "LICENSE"}
_PLAIN = argparse.Namespace(convert_SHs_python=False, compute_cov3D_python=False, debug=False)
_OFF = {"enabled": False}
_NO_EFFECTS = {  # the viewer's post effects
    "sharpness": {**_OFF, "amount": 0},
    "bloom": {**_OFF, "intensity": 0.1, "blurLevel": 2},
    "grading": {**_OFF, "brightness": 1, "contrast": 1, "saturation": 1, "tint": [1, 1, 1]},
    "vignette": {**_OFF, "intensity": 0.5, "inner": 0.3, "outer": 0.75, "curvature": 1},
    "fringing": {**_OFF, "intensity": 0.5},
}


def write_html(
    path: str | os.PathLike,
    splats: Splats,
    cameras: Sequence[Camera],
    make_path: Callable[[Poses], TimedPath] | None = None,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    title: str | None = None,
    start: int = 0,
    picture: str = "",
    upright: bool = False,
    metric: bool = False,
    notes: Notes | None = None,
    solid: "Solid | None" = None,
    pipe: argparse.Namespace = _PLAIN,
    once: Callable[..., str] = lambda _, make, *given: make(*given),
) -> None:
    """Write the page, whole or not at all. UserError without a camera.

    cameras: the training views; those that the notes name become bookmarks, or else up to 10 of them.
    make_path: makes the animation from the poses of the cameras; None: the viewer's own animation, around the model, or
    swaying where the page's first camera is in the model's box.
    background: RGB in [0, 1]. title: None: that of the notes, or the file's name. notes: texts on views.
    start: index of the page's first camera. picture: address of an image beside a link to the page; empty: none.
    upright: true if up is UP already; else the direction is found by the cameras.
    metric: true if a unit is a metre; else a headset shows the model as if photos were taken from two metres.
    solid: what visitors of the page stop at, in the viewer's axes; None: visitors cannot walk.
    pipe: options to find a note's point. once: calls what makes the packed model, or returns one made before.
    """
    if not cameras:
        raise UserError("a page needs at least one training camera, from which it shows the model; the scene has none")
    poses = poses_of(cameras)
    turn, names = np.eye(3) if upright else turn_upright(find_up(poses)), [str(camera.image_name) for camera in cameras]
    track = make_path(poses) if make_path else None
    # Of the Gaussians from the page's first camera, median.
    distance = float(np.median(np.linalg.norm(splats.means - poses.positions[start], axis=1))) if len(splats) else 1.0
    notes, aspects = notes or Notes(), [camera.image_width / camera.image_height for camera in cameras]
    pipe = argparse.Namespace(**(vars(pipe) | {"antialiasing": splats.antialiasing}))
    depth = float(np.median(_find_turning_depths(poses, focus_point(poses), distance)))
    thing = partial(_find_noted_point, model_of(splats), cameras, pipe) if notes.views else None
    page = {
        "antialiasing": splats.antialiasing,
        "aspect": aspects[start],
        "name": _NAME,
        "limits": find_limits(poses, _VIEWER_AXES @ turn, depth),
        "metre": 1.0 if metric else depth / _USUAL_DEPTH,
        "solid": solid and {"address": SOLID, "about": solid.about},
        "settings": make_settings(poses, names, turn, track, background, distance, start, aspects, notes.views, thing),
    }
    content = _read_template().render(
        background=", ".join(f"{255 * value:.0f}" for value in background),
        model=once("packed", lambda: _pack_model(rotated(splats, turn))),
        notes=notes,
        picture=picture,
        page=json.dumps(page, allow_nan=False).replace("<", "\\u003c"),  # no text in it may end its script element
        solid=_encode_base64(gzip.compress(solid.content, mtime=0)) if solid else "",
        title=(notes.title or Path(path).stem) if title is None else title,
    )
    with atomic_write(path) as temporary:
        # Names that are not UTF-8 have surrogates, which appear as numbers.
        temporary.write_text(content, encoding="utf-8", errors="backslashreplace")


def _read_template() -> jinja2.Template:
    """Read the template of the page, with the viewer."""
    options = {"autoescape": True, "undefined": jinja2.StrictUndefined, "trim_blocks": True, "lstrip_blocks": True}
    environment = jinja2.Environment(loader=jinja2.FileSystemLoader(Path(__file__).parent), **options)
    texts = {name: (FOLDER / file).read_text(encoding="utf-8") for name, file in _TEXTS.items()}
    viewer = _encode_base64((FOLDER / VIEWER).read_bytes())
    return environment.get_template("page.html.jinja", globals=dict(texts, record=read_json(RECORD), viewer=viewer))


def _encode_base64(content: bytes) -> str:
    return base64.b64encode(content).decode()


def _pack_model(splats: Splats) -> str:
    """Return the model as a compressed PLY file in gzip and Base64. UserError if browsers cannot read so much."""
    content = io.BytesIO()
    packed_ply(splats).write(content)
    packed = _encode_base64(_gzip(content.getbuffer()))
    if len(packed) > LONGEST:
        raise UserError(
            f"a page of {len(splats):,} Gaussians of SH degree {splats.sh_degree} would have {len(packed) / 1e6:.0f} "
            f"MB, and browsers read at most {LONGEST / 1e6:.0f}; export fewer by --max_splats or --sh_degree"
        )
    return packed


def _gzip(content: memoryview) -> bytes:
    """Compress to one gzip member (RFC 1952) on all cores, each piece with the end of the one before as dictionary."""
    starts = range(0, len(content), _PIECE)

    def deflate(start: int) -> bytes:
        before = bytes(content[max(start - _WINDOW, 0) : start])
        packer = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS, zdict=before)
        packed = packer.compress(content[start : start + _PIECE])
        return packed + packer.flush(zlib.Z_FINISH if start + _PIECE >= len(content) else zlib.Z_SYNC_FLUSH)

    pieces = in_threads(deflate, starts, desc="Packing the page", disable=len(starts) < _SHOWN)
    head = b"\x1f\x8b\x08\0\0\0\0\0\x02\xff"
    return head + b"".join(pieces) + struct.pack("<II", zlib.crc32(content), len(content) & 0xFFFFFFFF)


def find_up(poses: Poses) -> np.ndarray:
    """The direction (3,), of length 1, that is up for most cameras: the one in which their rolls are least.

    A level camera has its x axis at right angles to up, however far it looks down. So up is the eigenvector of the
    least eigenvalue of the mean of x x^T; where cameras face one way and leave it open, their mean up decides.
    """
    mean, across = poses.up, poses.turns[:, :, 0]
    mean = mean / max(float(np.linalg.norm(mean)), 1e-9)
    matrix = across.T @ across / len(poses) + _MEAN_UP * (np.eye(3) - np.outer(mean, mean))
    up = np.linalg.eigh(matrix)[1][:, 0]
    return up if up @ mean >= 0 else -up


def turn_upright(up: np.ndarray) -> np.ndarray:
    """The least rotation (3,3) that takes a direction to UP."""
    axis, cosine = np.cross(up, UP), float(up @ UP)
    sine = float(np.linalg.norm(axis))
    axis = axis / sine if sine > 1e-9 else np.array([0.0, 0.0, 1.0])
    return Rotation.from_rotvec(axis * np.arctan2(sine, cosine)).as_matrix()


def make_settings(
    poses: Poses,
    names: Sequence[str],
    turn: np.ndarray,
    path: TimedPath | None,
    background: tuple[float, float, float],
    distance: float = 1.0,
    start: int = 0,
    aspects: Sequence[float] | None = None,
    notes: Sequence[Note] = (),
    thing: Callable[[Note, int, float], np.ndarray] | None = None,
) -> dict[str, Any]:
    """Return the settings of the viewer, a JSON object, for a model that was turned by `turn` (3, 3).

    poses, names: of the training cameras, before the turn.
    turn: rotation (3, 3) from the scene's axes to upright ones.
    path: the animation, in the frame of the poses; None: no animation.
    background: RGB in [0, 1].
    distance: distance to the model, around which the view turns, where all cameras are in one place and tell none.
    start: index of the camera that the viewer begins at.
    aspects: width over height of each photo; None: all are square.
    notes: the bookmarks with texts; without any, there are BOOKMARKS of the cameras.
    thing: returns the point (3,) that a note is about, in the frame of the poses. Its arguments are the note, the index
    of the note's camera and the usual depth of what that camera shows.

    Opening angles are vertical, in degrees.
    """
    aspects = aspects or [1.0] * len(poses)
    axes = _VIEWER_AXES @ turn
    focus = focus_point(poses)
    depths = _find_turning_depths(poses, focus, distance)
    cameras = [
        _make_camera(axes, *camera) for camera in zip(poses.positions, poses.turns, depths, poses.fov, strict=True)
    ]
    if notes:
        marked = [(find_named(note.camera, names, f"--notes: {note.camera}"), note.name, note.text) for note in notes]
    else:
        chosen = np.unique(np.linspace(0, len(cameras) - 1, BOOKMARKS).round().astype(int)).tolist()
        marked = [(n, f"View {place} of {len(chosen)}", "") for place, n in enumerate(chosen, 1)]
    marks = [
        _make_bookmark(title, text, cameras[n], measure_lean(axes @ poses.turns[n]), aspects[n])
        for n, title, text in marked
    ]
    if notes:  # stand at the things, where the viewer shows their texts
        for mark, note, (n, _, _) in zip(marks, notes, marked, strict=True):
            mark["position"] = (axes @ thing(note, n, depths[n])).tolist()
    return {
        "version": 2,
        "tonemapping": "none",
        "highPrecisionRendering": False,
        "background": {"color": list(background)},
        "postEffectSettings": _NO_EFFECTS,
        "animTracks": [] if path is None else [_make_track(path, axes, float(np.median(depths)))],
        "cameras": [{"initial": cameras[start]}],
        "annotations": marks,
        "startMode": "default" if path is None else "animTrack",
    }


def _find_turning_depths(poses: Poses, focus: np.ndarray | None, distance: float) -> np.ndarray:
    """Return the depth (N,) of the point about which each camera turns, along its axis: at the focus, or near it."""
    if focus is None:
        return np.full(len(poses), max(poses.spread or distance, 1e-3))
    ahead = ((focus - poses.positions) * poses.forward).sum(axis=1)
    return np.where(ahead > 0, ahead, np.median(ahead))


def _find_noted_point(
    gaussians: GaussianModel, cameras: Sequence[Camera], pipe: argparse.Namespace, note: Note, row: int, usual: float
) -> np.ndarray:
    """The point (3,) that a note of a camera means: on the surface, or as far away as is usual where there is none."""
    camera, pose = cameras[row], poses_of([cameras[row]])
    ray = ray_through(camera, *note.at) if note.at else np.zeros(3)
    ray = unit(ray) if ray.any() else pose.forward[0]
    key = keyframe(0.0, pose.positions[0], look_along(ray, -pose.turns[0, :, 1]), pose.fov[0])
    size = camera.image_width | 1, camera.image_height | 1  # so that the ray is in the middle of a pixel
    view = free_view(*size, np.radians(key.fov), key.position, key.wxyz, gaussians.get_xyz.device)
    return pose.positions[0] + (median_at(view, gaussians, pipe, size[0] // 2, size[1] // 2) or usual) * ray


def find_limits(poses: Poses, axes: np.ndarray, depth: float) -> list[list[float]]:
    """Return the lowest and the highest corner [x, y, z] of the box in which visitors of the page may move.

    The box is that of all cameras with a margin, in the viewer's world: x right, y up, z backwards, the model's scale.

    axes: (3, 3), from the model's axes to the viewer's.
    depth: distance from the cameras to what they usually look at.
    """
    places = poses.positions @ axes.T
    room = depth * np.array([_ASIDE, _UNDER, _ASIDE])
    return [(places.min(axis=0) - room).tolist(), (places.max(axis=0) + depth * _ASIDE).tolist()]


def measure_lean(turn: np.ndarray) -> float:
    """Degrees by which a camera with axes `turn` (3,3) in the viewer's world must be rolled from a level one.

    About its backward axis, and level as the viewer's cameras are: turned about y, then about their own x.
    """
    yaw = np.arctan2(-turn[0, 2], -turn[2, 2])
    level = np.array([np.cos(yaw), 0, -np.sin(yaw)])
    return float(np.degrees(np.arctan2(turn[:, 1] @ level, turn[:, 0] @ level)))


def _make_camera(axes: np.ndarray, position: np.ndarray, turn: np.ndarray, depth: float, fov: float) -> dict[str, Any]:
    target = position + depth * turn[:, 2]
    return {"position": (axes @ position).tolist(), "target": (axes @ target).tolist(), "fov": float(fov)}


def _make_bookmark(name: str, text: str, camera: dict[str, Any], degrees: float, aspect: float) -> dict[str, Any]:
    """An annotation at the camera's own place. The viewer's cameras are level, so our page adds the lean.

    aspect: of the photo, which the page lets fill a window's width.
    """
    return {
        "position": camera["position"],
        "title": name if len(name) <= _TITLE else name[: _TITLE - 1] + "…",
        "text": text,
        "camera": {"initial": camera},
        "extras": {"lean": degrees, "aspect": aspect},
    }


def _make_track(path: TimedPath, axes: np.ndarray, depth: float) -> dict[str, Any]:
    """Return the viewer's animation of a camera path, with evenly spaced keyframes.

    axes: (3, 3), from the path's axes to the viewer's.
    depth: distance from each position to the point that the camera looks at.
    """
    count = max(2, min(_MOST_KEYS, round(path.seconds * _KEYS_A_SECOND) + 1))
    rate = (count - 1) / path.seconds
    frames = range(count - path.closed)  # the end of a closed path is its beginning
    keys = [path.at(min(frame / rate, path.seconds)) for frame in frames]
    turns = Rotation.from_quat([key.wxyz for key in keys], scalar_first=True).as_matrix()
    looks = [_make_camera(axes, np.array(k.position), turn, depth, k.fov) for k, turn in zip(keys, turns, strict=True)]
    return {
        "name": "camera path",
        "duration": path.seconds,
        "frameRate": rate,
        "loopMode": "repeat" if path.closed else "none",
        "interpolation": "spline",
        "smoothness": 1,
        "keyframes": {
            "times": list(frames),
            "values": {
                "position": [value for look in looks for value in look["position"]],
                "target": [value for look in looks for value in look["target"]],
                "fov": [look["fov"] for look in looks],
            },
        },
    }
