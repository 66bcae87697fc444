"""Videos of camera paths: options of render.py, the request that they describe, and its rendering."""

import argparse
import contextlib
import math
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from gaussian_renderer import render
from gaussian_renderer.camera_paths.keyframes import (
    KeyframePath,
    TimedPath,
    frame_count,
    frame_moment,
    read_camera_path,
)
from gaussian_renderer.camera_paths.video import find_ffmpeg, write_video
from gaussian_renderer.free_view import free_view
from gaussian_renderer.memory_errors import explain_memory_errors
from groundwork.files.image_files import pictures_at_once, replace_pictures, to_bytes, write_png
from groundwork.host.progress import Bar, in_threads
from scene.cameras import Camera
from scene.scene import Scene
from utils.system_utils import UserError

TOP = "top"  # the picture of from_above.py

if TYPE_CHECKING:
    from gaussian_renderer.camera_paths.poses import Poses
    from gaussian_renderer.camera_paths.without_scene import WithoutScene

FPS = 30
MOST_FPS = 240
LARGEST_SIDE = 16384  # of x264
LEAST_SECONDS, MOST_SECONDS = 0.1, 3600
_WITH_PATH = ("fps", "size", "seconds", "frames")
_OF_VIDEOS = ("fps", "seconds", "frames")
_WITHOUT_PATH = ("depth", "alpha")


def add_path_options(parser: argparse.ArgumentParser) -> None:
    """Add --path and the options that go with it to a parser."""
    group = parser.add_argument_group("Camera path")
    kinds = "interpolate, ellipse, spiral, or a JSON file of keyframes, or a picture from above: top"
    group.add_argument("--path", metavar="PATH", help=f"write a video along {kinds}; no views (default: none)")
    group.add_argument("--fps", type=int, metavar="N", help="frames a second (default: 30)")
    size = "width and height, even (default: that of the first training camera, made even; of top, 1600 for the longer)"
    group.add_argument("--size", type=int, nargs=2, metavar=("W", "H"), help=size)
    group.add_argument("--seconds", type=float, metavar="S", help="seconds of a path that is no file (default: 10)")
    group.add_argument("--frames", action="store_true", help="write each frame as PNG, too (default: off)")


@dataclass(frozen=True)
class PathRequest:
    """A video to make, or a picture from above.

    name: name of its files.
    make: makes the path from the training cameras' poses; None: a picture from above.
    fps: frames a second.
    size: width and height, even; None: the first training camera's, made even.
    frames: whether to write PNGs.
    """

    name: str
    make: Callable[["Poses"], TimedPath] | None
    fps: int = FPS
    size: tuple[int, int] | None = None
    frames: bool = False


def path_request(args: argparse.Namespace) -> PathRequest | None:
    """Make the request of a command line with the options of `add_path_options`; None without --path.

    Reads the keyframe file and looks for ffmpeg. UserError for options that do not go together, a wrong value, a wrong
    file or a missing ffmpeg.
    """
    for name in _WITHOUT_PATH if args.path is not None else _WITH_PATH:
        if getattr(args, name) not in (None, False):
            kind, remedy = ("without --path", "or --path") if args.path else ("with --path", "or pass --path, too")
            raise UserError(f"--{name} works only {kind}; leave it out, {remedy}")
    if args.path is None:
        return None
    if args.path == TOP:
        for name in _OF_VIDEOS:
            if getattr(args, name) not in (None, False):
                raise UserError(f"--path {TOP} is one picture, without --{name}; leave it out")
        return PathRequest(TOP, None, size=args.size and _check_size(*args.size))
    fps = FPS if args.fps is None else args.fps
    if not 1 <= fps <= MOST_FPS:
        raise UserError(f"--fps must be 1 to {MOST_FPS}, got {fps}")
    size = args.size and _check_size(*args.size)
    make = path_maker(args.path, args.seconds, [TOP])
    find_ffmpeg()
    return PathRequest(Path(args.path).stem, make, fps, size, args.frames)


def _check_size(width: int, height: int) -> tuple[int, int]:
    """Return a video's width and height, pixels, if both are even and in range; else raise a UserError."""
    if not (2 <= width <= LARGEST_SIDE and 2 <= height <= LARGEST_SIDE):
        raise UserError(f"--size must be two even numbers of 2 to {LARGEST_SIDE} pixels, got {width} {height}")
    if width % 2 or height % 2:
        raise UserError(
            f"--size {width} {height} has an odd side, which players of H.264 do not take; "
            f"use --size {width - width % 2} {height - height % 2}"
        )
    return width, height


def path_maker(path: str, seconds: float | None = None, others: Sequence[str] = ()) -> Callable[["Poses"], TimedPath]:
    """A function that makes the path of --path from the training cameras' poses. UserError for a wrong value.

    path: value of --path.
    seconds: duration of a generated path; None: 10.
    others: further names that the command takes.
    """
    from gaussian_renderer.camera_paths.generated import GENERATED, SECONDS  # SciPy takes a while to import

    if path in GENERATED:
        seconds = SECONDS if seconds is None else seconds
        if not LEAST_SECONDS <= seconds <= MOST_SECONDS:
            raise UserError(f"--seconds must be {LEAST_SECONDS} to {MOST_SECONDS}, got {seconds:g}")
        return lambda poses: GENERATED[path](poses, seconds)
    if seconds is not None:
        raise UserError(f"--seconds works with {', '.join(GENERATED)} only; {path} has its own times")
    if not os.path.exists(path):  # unlike Path.exists, it knows that no file has an empty or an endless name
        raise UserError(
            f"--path must be {', '.join((*GENERATED, *others))} or a file of keyframes; there is no file {path}"
        )
    keyframes = KeyframePath(read_camera_path(Path(path)))
    if not LEAST_SECONDS <= keyframes.seconds <= MOST_SECONDS:
        raise UserError(
            f"{path} lasts {keyframes.seconds:g} s, and a path lasts {LEAST_SECONDS} to {MOST_SECONDS}; "
            "give the keyframes' times in seconds"
        )
    return lambda _: keyframes


@torch.no_grad()
def render_path(
    scene: "Scene | WithoutScene", pipe: argparse.Namespace, background: torch.Tensor, request: PathRequest
) -> Path:
    """Write the video of a path, and its frames if they are asked for; return the video's path.

    scene: with a loaded model. pipe: the pipeline options. background: (3,) in [0, 1].

    Files: MODEL/videos/ours_N/NAME.mp4 and MODEL/videos/ours_N/NAME/00000.png ...; at the end they take the place of
    an earlier run's. UserError if the path cannot be made of the scene's cameras, or if something cannot be written.
    """
    from gaussian_renderer.camera_paths.poses import poses_of  # SciPy takes a while to import

    cameras = scene.getTrainCameras()
    if not cameras:
        raise UserError(f"the scene of {scene.model_path} has no training cameras, which --path needs; check the scene")
    path = request.make(poses_of(cameras))
    width, height = request.size or even_size(cameras[0])
    count = frame_count(path, request.fps)
    folder = Path(scene.model_path) / "videos" / f"ours_{scene.loaded_iter}"
    video, images = folder / f"{request.name}.mp4", folder / request.name
    remedy = "pass a smaller --size" if request.size else "lower --resolution (-r), or pass a smaller --size"
    coming = images.with_name(f".{request.name}.tmp")

    @torch.no_grad()  # in whichever thread
    def draw(number: int) -> np.ndarray:
        pose = path.at(frame_moment(path, request.fps, number))
        view = free_view(width, height, math.radians(pose.fov), pose.position, pose.wxyz, background.device)
        with explain_memory_errors(scene.gaussians, [view], remedy):
            drawn = render(view, scene.gaussians, pipe, background, want_depth=False, want_visibility=False)
            return to_bytes(drawn["render"]).numpy()

    def draw_some(numbers: Sequence[int]) -> list[np.ndarray]:
        drawn = list(map(draw, numbers))
        if request.frames:
            in_threads(write_png, drawn, [coming / f"{number:05d}.png" for number in numbers], disable=True)
        return drawn

    def frames() -> Iterator[np.ndarray]:
        size = pictures_at_once(width * height)
        parts = (range(first, min(first + size, count)) for first in range(0, count, size))
        with ThreadPoolExecutor(1) as ahead, Bar(total=count, desc=f"Rendering {request.name}", unit="frame") as bar:
            waiting = None
            for part in (*parts, None):
                drawn = waiting.result() if waiting else []
                waiting = part and ahead.submit(draw_some, part)  # while those that are drawn are encoded
                for pixels in drawn:
                    yield pixels
                    bar.update()

    shutil.rmtree(coming, ignore_errors=True)  # of a killed run
    try:
        with contextlib.closing(frames()) as drawn:
            write_video(video, drawn, width, height, request.fps)
        replace_pictures(images, coming)
    finally:
        shutil.rmtree(coming, ignore_errors=True)
    seconds, size = count / request.fps, video.stat().st_size / 1e6
    print(f"{video}: {count} frames of {width} x {height}, {seconds:.2f} s, {size:.2f} MB")
    return video


def even_size(camera: Camera) -> tuple[int, int]:
    """Width and height of a view, odd ones a pixel smaller: yuv420p needs even ones."""
    width, height = int(camera.image_width), int(camera.image_height)
    return max(2, width - width % 2), max(2, height - height % 2)
