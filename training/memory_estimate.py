"""Estimate of the memory that a training needs, printed before it starts."""

import math
import sys

import torch

from scene import Scene
from scene.gaussian_model import GaussianModel
from utils.host.memory import free_memory, gib
from utils.host.torchrun import local_size

# Bytes besides the parameters, their gradients and Adam's two averages. 106 and 57 were fitted to the peak memory of
# forward and backward in docs/results/kernels.md (100 thousand to 6 million Gaussians, within 4 %). The rest are the
# statistics of density control, and the images that the loss keeps.
PER_GAUSSIAN = 106 + 20
PER_PIXEL = 57 + 72
# Of absolute gradients: their length, and two values more beside the ten of a tile's gradient of a Gaussian, of which
# the 106 bytes are the most part.
PER_ABSOLUTE = 4 + 106 // 5
GROWTH = 20  # photo scenes grow 10- to 100-fold in 7,000 iterations (docs/results/training.md), random points 2-fold


def announce_memory(scene: Scene, gaussians: GaussianModel, max_splats: int, absolute: bool = False) -> None:
    """Print the memory that photos and Gaussians need and what is free; warn, with a remedy, if they do not fit.

    max_splats: limit of the number of Gaussians. Without a limit (0), the estimate is for GROWTH times the number now.
    absolute: with absolute gradients. Of several ranks, each says what itself needs.
    """
    images, device = scene.images, gaussians.get_xyz.device
    pixels = max(camera.image_width * camera.image_height for camera in scene.getTrainCameras())
    now, size = gaussians.total, gaussians.shards.ranks.size
    later = max(max_splats, now) if max_splats else GROWTH * now
    why = "--max_num_splats" if max_splats else f"scenes often grow {GROWTH}-fold"
    sizes = (-(-count // size) for count in (now, later))
    at_start, at_end = (training_bytes(gaussians, count, pixels, absolute) for count in sizes)
    training = f"training {gib(at_start)} with {now:,} Gaussians, {gib(at_end)} with {later:,} ({why})"
    each = f" for each of {size} processes" if size > 1 else ""
    pictures = images.planned_bytes
    photos = f"photos {gib(pictures)}"
    if images.limit:
        photos += f" (--images_to_load keeps {images.limit:,} of {images.planned:,} decoded images)"
    together = images.keep_on.type == device.type and (images.keep_on.index or 0) == (device.index or 0)
    if not together:
        room = _announce(images.keep_on, photos + each, pictures)
        if room < 0:
            _warn(images.keep_on, "all photos", "set --images_to_load, or lower --resolution (-r)")
        pictures = 0
    room = _announce(device, (f"{photos}, {training}" if together else training) + each, pictures)
    if room < at_start:
        _warn(device, f"{now:,} Gaussians", "set --images_to_load, or lower --resolution (-r) or --sh_degree")
    elif room < at_end:
        remedy = "set a lower --max_num_splats, or --images_to_load, or lower --resolution (-r) or --sh_degree"
        _warn(device, f"{later:,} Gaussians", remedy)


def _announce(device: torch.device, content: str, pictures: int) -> float:
    """Print one device's line. Return the bytes that are free besides the photos, infinity if that is not known.

    The processes of a host have equal parts of what its CPU has free.
    """
    free, sharing = free_memory(device), local_size() if device.type == "cpu" else 1
    if free is not None:
        free //= sharing
    known = ("?" if free is None else gib(free)) + " free" + (" for each" if sharing > 1 else "")
    print(f"Memory of the {_name(device)}, estimated: {content}; {known}")
    return math.inf if free is None else free - pictures


def _warn(device: torch.device, what: str, remedy: str) -> None:
    print(f"warning: the memory of the {_name(device)} seems too small for {what}; {remedy}", file=sys.stderr)


def _name(device: torch.device) -> str:
    return "GPU" if device.type == "cuda" else "CPU"


def training_bytes(gaussians: GaussianModel, count: int, pixels: int, absolute: bool = False) -> int:
    """Bytes of `count` Gaussians with all that training keeps for them, and of one view's buffers.

    absolute: with absolute gradients.
    """
    values = sum(group["params"][0][:1].numel() for group in gaussians.optimizer.param_groups)
    each = 4 * 4 * values + PER_GAUSSIAN + absolute * PER_ABSOLUTE
    return count * each + pixels * PER_PIXEL
