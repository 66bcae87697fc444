"""Memory and disk space that a training needs, printed before it starts where that is much of what is free."""

import math
import shutil
import sys
from pathlib import Path
from typing import Any

import torch

from groundwork.finding import Finding
from groundwork.host.memory import free_memory, gib
from groundwork.host.torchrun import local_size
from scene import Scene
from scene.gaussian_model import GaussianModel
from scene.images.store import ImageStore
from utils.system_utils import UserError

# Bytes besides the parameters and Adam's two averages. 106 and 57 were fitted to the peak memory of
# forward and backward in docs/results/kernels.md (100 thousand to 6 million Gaussians, within 4 %). The rest are the
# statistics of density control, and the images that the loss keeps.
PER_GAUSSIAN = 106 + 20
PER_PIXEL = 57 + 72
# Of absolute gradients: their length, and two values more beside the ten of a tile's gradient of a Gaussian, of which
# the 106 bytes are the most part.
PER_ABSOLUTE = 4 + 106 // 5
GROWTH = 20  # photo scenes grow 10- to 100-fold in 7,000 iterations (docs/results/training.md), random points 2-fold
REMEDY = "--images_to_load, or lower --resolution (-r) or --sh_degree"
LITTLE = 0.1  # of what is free, of which nobody has to know
_OF_PLY = 3  # numbers of a Gaussian besides its own: normals, which are 0
_OF_CHECKPOINT = 3  # the same: statistics of density control. Its own come with Adam's two averages


def expected_count(max_splats: int, now: int) -> int:
    """Return the number of Gaussians to expect: `max_splats`; without such a limit (0), GROWTH times the number now."""
    return max(max_splats, now) if max_splats else GROWTH * now


def announce_memory(
    scene: Scene, gaussians: GaussianModel, max_splats: int, absolute: bool = False, size: int = 1
) -> None:
    """Print the memory that photos and Gaussians need and what is free; warn, with a remedy, if they do not fit.

    max_splats: largest number of Gaussians, 0: any number.
    absolute: true with absolute gradients.
    size: number of processes that train together; each prints its own needs.
    """
    images, device, space = scene.images, gaussians.get_xyz.device, gaussians.storage
    pixels = largest_view(scene)
    now = gaussians.gaussian_count
    later = expected_count(max_splats, now)
    why = "--max_num_splats" if max_splats else f"scenes often grow {GROWTH}-fold"
    per_rank = [-(-count // size) for count in (now, later)]
    at_start, at_end = (
        training_bytes(gaussians, count, pixels, absolute) - (space.host_bytes(count) if space else 0)
        for count in per_rank
    )
    training = f"{later:,} Gaussians ({why}) {gib(at_end)}"
    each = f" for each of {size} processes" if size > 1 else ""
    pictures = images.planned_bytes
    photos = f"photos {gib(pictures)}"
    if images.limit:
        photos += f" (--images_to_load keeps {images.limit:,} of {images.planned:,} decoded images)"
    together = _keeps_photos(images, device)
    if not together:
        room = announce_device(images.keep_on, photos + each, pictures, pictures)
        if room < 0:
            warn_of(images.keep_on, "all photos", "set --images_to_load, or lower --resolution (-r)")
        pictures = 0
    content = (f"{photos}, {training}" if together else training) + each
    room = announce_device(device, content, pictures, pictures + at_end, space.limit if space else 0)
    for count, own, needed, first in (
        (now, per_rank[0], at_start, "set "),
        (later, per_rank[1], at_end, "set a lower --max_num_splats, or "),
    ):
        if room < needed:
            option = space.remedy(own, needed - room) if space else ""
            warn_of(device, f"{count:,} Gaussians", f"{option}{first}{REMEDY}")
            break


def announce_device(device: torch.device, content: str, pictures: int, needed: int, limit: int = 0) -> float:
    """Print the memory that is needed of a device, unless that is little of what is free or of what a limit allows.

    Return the bytes that are free besides the photos, infinity if that is not known. The processes of a host have equal
    parts of what its CPU has free.

    content: text that says what needs the memory.
    pictures: bytes of the photos.
    needed: bytes of all.
    limit: bytes that may be taken of a GPU, 0: no limit.
    """
    free, sharing = free_memory(device), local_size() if device.type == "cpu" else 1
    if free is not None:
        free = limit if limit and device.type == "cuda" else free // sharing
    if free is None or needed > LITTLE * free:
        print(f"{_device_word(device)} memory: about {gib(needed)} of {'?' if free is None else gib(free)}: {content}")
    return math.inf if free is None else free - pictures


def warn_of(device: torch.device, what: str, remedy: str) -> None:
    """Warn that a device has too little memory.

    what: what does not fit.
    remedy: what to set.
    """
    print(f"warning: the memory of the {_device_word(device)} seems too small for {what}; {remedy}", file=sys.stderr)


def _device_word(device: torch.device) -> str:
    return "GPU" if device.type == "cuda" else "CPU"


def training_bytes(gaussians: GaussianModel, count: int, pixels: int, absolute: bool = False) -> int:
    """Return the bytes of `count` Gaussians with all that training keeps for them, and of one view's buffers.

    pixels: pixels of the view.
    absolute: true with absolute gradients.
    """
    sizes = [math.prod(attribute.shape) for attribute in gaussians._attributes.values()]
    each = 4 * (3 * sum(sizes) + max(sizes))  # no step writes gradients; rows change in one tensor after the other
    return count * (each + PER_GAUSSIAN + absolute * PER_ABSOLUTE) + pixels * PER_PIXEL


def photo_bytes(images: ImageStore, device: torch.device) -> int:
    """Return the bytes of the photos that a device keeps."""
    return images.planned_bytes if _keeps_photos(images, device) else 0


def largest_view(scene: Scene) -> int:
    """Return the number of pixels of the largest photo."""
    return max(camera.image_width * camera.image_height for camera in scene.getTrainCameras())


def _keeps_photos(images: ImageStore, device: torch.device) -> bool:
    return images.keep_on.type == device.type and (images.keep_on.index or 0) == (device.index or 0)


def little_space(run: Any, sure: int, later: int, first: int) -> Finding | None:
    """Return a warning if the disk is too small for saves of `later` Gaussians from iteration `first` on, or None.

    UserError if not even one PLY fits.

    sure: number of Gaussians that there are at least.
    """
    folder = Path(run.scene.model_path).absolute()
    free = shutil.disk_usage(next(place for place in (folder, *folder.parents) if place.exists())).free
    values = sum(math.prod(attribute.shape) for attribute in run.gaussians._attributes.values())
    ply, checkpoint = 4 * (values + _OF_PLY), 4 * (3 * values + _OF_CHECKPOINT)
    if free < ply * sure:
        raise UserError(
            f"the disk of {folder} has {_mb(free)} free, and a model of {sure:,} Gaussians takes {_mb(ply * sure)}; "
            "free space there, or name another folder by -m"
        )
    planned = [run.schedule.known(one) for one in (run.launch.save_iterations, run.launch.checkpoint_iterations)]
    saves, checkpoints = (len({n for n in one if n >= first}) for one in planned)
    needed = later * (ply * max(saves, 1) + checkpoint * checkpoints)
    if free >= needed:
        return None
    text = f"the disk of {folder} has {_mb(free)} free, and the saves to come take about {_mb(needed)}"
    return Finding(f"{text} if there are {later:,} Gaussians", "free space there in time")


def _mb(count: float) -> str:
    return f"{count / 1e6:,.1f} MB"
