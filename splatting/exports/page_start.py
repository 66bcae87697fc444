"""Where a page begins, and the picture of it that other pages and messengers show beside a link."""

import argparse
import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from gaussian_renderer import render
from gaussian_renderer.free_view import free_view
from scene.cameras import Camera
from scene.splats.splats import Splats
from scene.with_splats import model_of
from splatting.camera_paths.poses import Poses, focus_point, opening, poses_of
from splatting.files.image_files import to_bytes
from splatting.files.ours import write_picture
from splatting.host.listing import some
from utils.system_utils import UserError

LEAST = 0.85  # of a photo's height that is shown, however wide the window is
PICTURE = 1200, 630  # px, as services ask for
_QUALITY = 88  # of its JPEG
_ALIKE = 1e-3  # scores that differ by less are equal
_FARTHER = 1.5  # of the usual distance: from there a view shows more of the middle, and no less well


def best_start(poses: Poses) -> int:
    """The camera that looks most straight at what all look at, from a usual distance or somewhat farther away.

    The first of equals. One radian off the axis counts as much as being nearer, or too far, by a factor of e.
    """
    focus = focus_point(poses)
    if focus is None:
        return 0
    offsets = focus - poses.positions
    distances = np.linalg.norm(offsets, axis=1).clip(1e-9)
    angles = np.arccos(np.clip((offsets * poses.forward).sum(1) / distances, -1, 1))
    usual = np.median(distances)
    scores = angles + np.abs(np.log(distances / np.clip(distances, usual, _FARTHER * usual)))
    return int(np.argmax(scores <= scores.min() + _ALIKE))


def named(name: str, names: Sequence[str], said: str) -> int:
    """The camera of a photo, whose name may lack its ending. UserError if there is none, with `said`."""
    for found in (list(names), [os.path.splitext(one)[0] for one in names]):
        if name in found:
            return found.index(name)
    raise UserError(f"{said} is no training photo; there are {some(names)}")


def narrowed(fov: float, photo: float, window: float) -> float:
    """The vertical opening angle, radians, at which a photo fills a window's width, and LEAST of its height is shown.

    fov: of the photo. photo, window: width over height. page.js has the same formula.
    """
    return 2 * math.atan(math.tan(fov / 2) * max(min(1.0, photo / window), LEAST))


@torch.no_grad()
def write_preview(
    path: str | os.PathLike,
    splats: Splats,
    camera: Camera,
    pipe: argparse.Namespace,
    background: tuple[float, float, float],
) -> None:
    """Write a JPEG of the first picture, in a window of PICTURE."""
    (width, height), poses = PICTURE, poses_of([camera])
    fov = narrowed(opening(camera), camera.image_width / camera.image_height, width / height)
    model = model_of(splats)
    place = poses.positions[0].tolist(), poses.quaternions[0].tolist()
    view = free_view(width, height, fov, *place, model.get_xyz.device)
    pipe = argparse.Namespace(**(vars(pipe) | {"antialiasing": splats.antialiasing}))
    image = render(view, model, pipe, model.get_xyz.new_tensor(background), want_depth=False)["render"]
    write_picture(Path(path), Image.fromarray(to_bytes(image).numpy()), quality=_QUALITY)
