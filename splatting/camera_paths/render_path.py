"""Rendering of a camera path into a video, frame by frame."""

import argparse
import math
from pathlib import Path

import torch
from tqdm import tqdm

from gaussian_renderer import render
from gaussian_renderer.free_view import free_view
from gaussian_renderer.memory_errors import memory_errors_explained
from scene.cameras import Camera
from scene.scene import Scene
from splatting.camera_paths.moments import frame_count, frame_moment
from splatting.camera_paths.poses import poses_of
from splatting.camera_paths.request import PathRequest
from splatting.camera_paths.video import video_writer
from splatting.files.numbered_pngs import remove_leftovers, save_png, to_bytes
from utils.system_utils import UserError


@torch.no_grad()
def render_path(scene: Scene, pipe: argparse.Namespace, background: torch.Tensor, request: PathRequest) -> Path:
    """Write the video of a path, and its frames if they are asked for; return the video's path.

    scene: with a loaded model. pipe, background: as for `render`. Files: MODEL/videos/ours_N/NAME.mp4 and
    MODEL/videos/ours_N/NAME/00000.png ...; frames of an earlier run are removed. UserError if the path cannot be made
    of the scene's cameras, or if something cannot be written.
    """
    cameras = scene.getTrainCameras()
    if not cameras:
        raise UserError(f"the scene of {scene.model_path} has no training cameras, which --path needs; check the scene")
    path = request.make(poses_of(cameras))
    width, height = request.size or even_size(cameras[0])
    count = frame_count(path, request.fps)
    folder = Path(scene.model_path) / "videos" / f"ours_{scene.loaded_iter}"
    video, images = folder / f"{request.name}.mp4", folder / request.name
    remedy = "pass a smaller --size" if request.size else "lower --resolution (-r), or pass a smaller --size"
    remove_leftovers(images, count if request.frames else 0)
    with video_writer(video, width, height, request.fps) as writer:
        for number in tqdm(range(count), desc=f"Rendering {request.name}", unit="frame"):
            pose = path.at(frame_moment(path, request.fps, number))
            view = free_view(width, height, math.radians(pose.fov), pose.position, pose.wxyz, background.device)
            with memory_errors_explained(scene.gaussians, [view], remedy):
                drawn = render(view, scene.gaussians, pipe, background, want_depth=False, want_visibility=False)
                pixels = to_bytes(drawn["render"])
            writer.write(pixels.numpy())
            if request.frames:
                save_png(pixels.permute(2, 0, 1), images / f"{number:05d}.png")
    seconds, size = count / request.fps, video.stat().st_size / 1e6
    print(f"{video}: {count} frames of {width} x {height}, {seconds:.2f} s, {size:.2f} MB")
    return video


def even_size(camera: Camera) -> tuple[int, int]:
    """Width and height of a view, odd ones a pixel smaller, as yuv420p needs even ones."""
    width, height = int(camera.image_width), int(camera.image_height)
    return max(2, width - width % 2), max(2, height - height % 2)
