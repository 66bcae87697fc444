"""The photo that a page begins at, and the picture of it that other pages and messengers show beside a link."""

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

import torch
from PIL import Image

from applications.export.notes import Note
from gaussian_renderer import render
from gaussian_renderer.camera_paths.poses import poses_of, vertical_fov
from gaussian_renderer.camera_paths.start import narrow_fov
from gaussian_renderer.free_view import free_view
from groundwork.files.image_files import to_bytes
from groundwork.files.ours import write_picture
from groundwork.host.listing import some
from scene.cameras import Camera
from scene.splats.splats import Splats
from scene.with_splats import model_of
from utils.system_utils import UserError

PICTURE = 1200, 630  # px, as services ask for
_QUALITY = 88  # of its JPEG


def find_named(name: str, names: Sequence[str], said: str) -> int:
    """Return the index of the photo `name`, with or without ending. UserError, which begins with `said`, if none."""
    for found in (list(names), [os.path.splitext(one)[0] for one in names]):
        if name in found:
            return found.index(name)
    raise UserError(f"{said} is no training photo; there are {some(names)}")


def check_note(note: Note, cameras: Sequence[Camera]) -> None:
    """UserError for a note that names no training photo, or a place outside of it."""
    names = [str(camera.image_name) for camera in cameras]
    width, height = cameras[find_named(note.camera, names, f"--notes: {note.camera}")].photo_size
    x, y = note.at or (0, 0)
    if x > width or y > height:
        fault = f"is at {x:g} {y:g}, outside of {note.camera} with {width} x {height} pixels"
        raise UserError(f"--notes: “{note.name}” {fault}; count pixels from its left and its top")


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
    fov = narrow_fov(vertical_fov(camera), camera.image_width / camera.image_height, width / height)
    model = model_of(splats)
    place = poses.positions[0].tolist(), poses.quaternions[0].tolist()
    view = free_view(width, height, fov, *place, model.get_xyz.device)
    pipe = argparse.Namespace(**(vars(pipe) | {"antialiasing": splats.antialiasing}))
    image = render(view, model, pipe, model.get_xyz.new_tensor(background), want_depth=False)["render"]
    write_picture(Path(path), Image.fromarray(to_bytes(image).numpy()), quality=_QUALITY)
