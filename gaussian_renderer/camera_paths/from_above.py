"""A picture of a scene from straight above (render.py --path top).

The rasterizer has no orthographic projection, so a camera far away with a small opening angle takes its place: things
that are higher by the width of the picture look larger by one part in `_AWAY`.
"""

import argparse
import math
from pathlib import Path

import numpy as np
import torch

from gaussian_renderer import render
from gaussian_renderer.camera_paths.poses import Poses, keyframe, poses_of, unit
from gaussian_renderer.camera_paths.render_path import TOP
from gaussian_renderer.camera_paths.start import best_start
from gaussian_renderer.free_view import free_view
from gaussian_renderer.memory_errors import explain_memory_errors
from groundwork.files.image_files import save_png
from groundwork.files.similarity import Similarity, local_similarity
from scene.scene import Scene
from utils.system_utils import UserError

_AWAY = 300.0  # widths of the picture, from the camera to what it shows
_LONGEST = 1600  # pixels of the longer side
_OUTLIERS = 0.02  # quantile of the Gaussians at which the picture ends
_RIM = 0.1  # of what is shown, on each side
_AROUND = 0.5  # of the cameras' largest distance from their middle, that is shown around them


@torch.no_grad()
def render_top(
    scene: Scene, source_path: str, pipe: argparse.Namespace, background: torch.Tensor, size: tuple[int, int] | None
) -> Path:
    """Write MODEL/videos/ours_N/top.png and return its path. size: width and height, None: from the scene's shape.

    Gaussians above all training cameras are left out, such as a ceiling: no photo shows them from above.
    """
    cameras = scene.getTrainCameras()
    if not cameras:
        raise UserError(f"the scene of {scene.model_path} has no training cameras, which --path needs; check the scene")
    poses, known = poses_of(cameras), local_similarity(scene.model_path, source_path)
    axes = upright_axes(poses, known)
    # In the upright frame x is right, y is down, and z is up in the picture.
    places = scene.gaussians.get_xyz @ torch.tensor(axes.T, dtype=torch.float32, device=background.device)
    below = places[:, 1] >= float((poses.positions @ axes.T)[:, 1].min())
    if not below.any():
        raise UserError(
            f"{scene.model_path} has no Gaussians below its highest camera; --path {TOP} has nothing to show"
        )
    low, high = _find_box(places[below][:, [0, 2]].double().cpu().numpy(), (poses.positions @ axes.T)[:, [0, 2]])
    (width, height), unit_a_pixel = _fit_size(high - low, size)
    away = _AWAY * unit_a_pixel * max(width, height)
    middle = (low + high) / 2
    ground = float(places[below][:, 1].median())
    place = axes.T @ np.array([middle[0], ground - away, middle[1]])
    fov = 2 * math.atan(unit_a_pixel * height / 2 / away)
    pose = keyframe(0.0, place, np.column_stack([axes[0], -axes[2], axes[1]]), math.degrees(fov))
    view = free_view(width, height, fov, pose.position, pose.wxyz, background.device)
    part = scene.gaussians.part(below, scene.gaussians.active_sh_degree)
    with explain_memory_errors(part, [view], "pass a smaller --size"):
        image = render(view, part, pipe, background, want_depth=False, want_visibility=False)["render"]
    path = Path(scene.model_path) / "videos" / f"ours_{scene.loaded_iter}" / f"{TOP}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    save_png(image, path)
    scale, name = (known.scale, "m") if known and known.metric else (1.0, "of the scene's units")
    print(f"{path}: {width} x {height}, a pixel is {scale * unit_a_pixel:.3g} {name}")
    return path


def upright_axes(poses: Poses, known: Similarity | None) -> np.ndarray:
    """The axes (3,3) of the upright frame, by rows, in the world: x right, y down, z ahead.

    They come from convert.py --orient, else from the cameras' up and the view that an exported page begins at.
    """
    if known is not None and known.upright:
        return known.rotation
    down = -poses.up
    if np.linalg.norm(down) < 1e-6:
        raise UserError("--path top needs to know what is up, which the photos do not tell; run convert.py --orient")
    down = unit(down)
    for ahead in poses.turns[best_start(poses)].T[[2, 0]]:  # the second one for a camera that looks straight down
        level = ahead - (ahead @ down) * down
        if np.linalg.norm(level) > 1e-3:
            break
    return np.stack([np.cross(down, unit(level)), down, unit(level)])


def _find_box(places: np.ndarray, cameras: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Opposite corners (2,) of the box to show, of places (N,2) around cameras (M,2)."""
    most = np.quantile(places, [_OUTLIERS, 1 - _OUTLIERS], axis=0)
    spread = _AROUND * float(np.linalg.norm(cameras - cameras.mean(0), axis=1).max())
    near = np.stack([cameras.min(0) - spread, cameras.max(0) + spread])
    low, high = np.maximum(most[0], near[0]), np.minimum(most[1], near[1])
    if not (high > low).all():
        low, high = most[0] - 1e-6, most[1] + 1e-6
    return low - _RIM * (high - low), high + _RIM * (high - low)


def _fit_size(shown: np.ndarray, size: tuple[int, int] | None) -> tuple[tuple[int, int], float]:
    """Width and height in pixels, and world units a pixel, that show a width and a height of the world (2,)."""
    if size is None:
        size = tuple(max(2, round(_LONGEST * float(side / shown.max()))) for side in shown)
    return size, float((shown / np.array(size)).max())
