"""Estimate of the memory that a training needs, printed before it starts if that is much of what is free."""

import math
import sys
from typing import Any

import torch

from scene import Scene
from scene.gaussian_model import GaussianModel
from scene.images.store import ImageStore
from splatting.host.memory import free_memory, gib
from splatting.host.torchrun import local_size

# Bytes besides the parameters and Adam's two averages. 106 and 57 were fitted to the peak memory of
# forward and backward in docs/results/kernels.md (100 thousand to 6 million Gaussians, within 4 %). The rest are the
# statistics of density control, and the images that the loss keeps.
PER_GAUSSIAN = 106 + 20
PER_PIXEL = 57 + 72
# Of absolute gradients: their length, and two values more beside the ten of a tile's gradient of a Gaussian, of which
# the 106 bytes are the most part.
PER_ABSOLUTE = 4 + 106 // 5
GROWTH = 20  # photo scenes grow 10- to 100-fold in 7,000 iterations (docs/results/training.md), random points 2-fold
_REMEDY = "--images_to_load, or lower --resolution (-r) or --sh_degree"


LITTLE = 0.1  # of what is free, of which nobody has to know


def expected_count(max_splats: int, now: int) -> int:
    """How many Gaussians there may be later. max_splats: their limit; without one (0), GROWTH times the number now."""
    return max(max_splats, now) if max_splats else GROWTH * now


def announce_memory(
    scene: Scene, gaussians: GaussianModel, memory: Any, max_splats: int, absolute: bool = False, size: int = 1
) -> None:
    """Print the memory that photos and Gaussians need and what is free; warn, with a remedy, if they do not fit.

    memory: the limit (gpu_memory.GpuMemory). max_splats: as for `expected_count`. absolute: with absolute gradients.
    size: of processes that train together; each says what itself needs.
    """
    images, device = scene.images, gaussians.get_xyz.device
    pixels = largest_view(scene)
    now = gaussians.gaussian_count
    later = expected_count(max_splats, now)
    why = "--max_num_splats" if max_splats else f"scenes often grow {GROWTH}-fold"
    per_rank = [-(-count // size) for count in (now, later)]
    spilled = [memory.spilled_bytes(count) for count in per_rank]
    at_start, at_end = (
        training_bytes(gaussians, count, pixels, absolute) - far for count, far in zip(per_rank, spilled, strict=True)
    )
    training = f"{later:,} Gaussians ({why}) {gib(at_end)}"
    each = f" for each of {size} processes" if size > 1 else ""
    pictures = images.planned_bytes
    photos = f"photos {gib(pictures)}"
    if images.limit:
        photos += f" (--images_to_load keeps {images.limit:,} of {images.planned:,} decoded images)"
    if spilled[1]:
        _announce_host(images, spilled[1], f"{later:,} Gaussians", each)
    together = _keeps(images, device)
    if not together:
        room = _announce(images.keep_on, photos + each, pictures, pictures)
        if room < 0:
            _warn(images.keep_on, "all photos", "set --images_to_load, or lower --resolution (-r)")
        pictures = 0
    content = (f"{photos}, {training}" if together else training) + each
    room = _announce(device, content, pictures, pictures + at_end, memory.limit)
    for count, own, needed, first in (
        (now, per_rank[0], at_start, "set "),
        (later, per_rank[1], at_end, "set a lower --max_num_splats, or "),
    ):
        if room < needed:
            helps = device.type == "cuda" and not memory.limit and needed - spillable_bytes(gaussians, own) <= room
            spill = "set --gpu_memory, or " if helps else ""
            _warn(device, f"{count:,} Gaussians", f"{spill}{first}{_REMEDY}")
            break


def _announce_host(images: ImageStore, needed: int, what: str, each: str) -> None:
    """Print what is spilled into the host's memory, besides photos there; warn if it does not fit."""
    host = torch.device("cpu")
    pictures = images.planned_bytes if images.keep_on == host else 0
    room = _announce(host, f"{gib(needed)} of {what}{each}", pictures, pictures + needed)
    if room < needed:
        _warn(host, what, f"set a lower --max_num_splats, or {_REMEDY}")


def _announce(device: torch.device, content: str, pictures: int, needed: int, limit: int = 0) -> float:
    """Print what one device needs, unless it is little of what is free, or of what may be taken of a GPU.

    Return the bytes that are free besides the photos, infinity if that is not known.

    The processes of a host have equal parts of what its CPU has free.
    """
    free, sharing = free_memory(device), local_size() if device.type == "cpu" else 1
    if free is not None:
        free = limit if limit and device.type == "cuda" else free // sharing
    if free is None or needed > LITTLE * free:
        print(f"{_name(device)} memory: about {gib(needed)} of {'?' if free is None else gib(free)}: {content}")
    return math.inf if free is None else free - pictures


def _warn(device: torch.device, what: str, remedy: str) -> None:
    print(f"warning: the memory of the {_name(device)} seems too small for {what}; {remedy}", file=sys.stderr)


def _name(device: torch.device) -> str:
    return "GPU" if device.type == "cuda" else "CPU"


def training_bytes(gaussians: GaussianModel, count: int, pixels: int, absolute: bool = False) -> int:
    """Bytes of `count` Gaussians with all that training keeps for them, and of one view's buffers.

    absolute: with absolute gradients.
    """
    sizes = [math.prod(attribute.shape) for attribute in gaussians._attributes.values()]
    each = 4 * (3 * sum(sizes) + max(sizes))  # no step writes gradients; rows change in one tensor after the other
    return count * (each + PER_GAUSSIAN + absolute * PER_ABSOLUTE) + pixels * PER_PIXEL


def spillable_bytes(gaussians: GaussianModel, count: int) -> int:
    """Bytes of what of `count` Gaussians may lie in the host's memory: SH bands above 0 and their two averages."""
    return count * 4 * 3 * math.prod(gaussians._attributes["f_rest"].shape)


def near_rows(limit: float, count: int, others: float, spillable: float) -> int:
    """How many rows of what may lie in the host's memory stay on a GPU, of which `limit` bytes may be taken.

    others, spillable: bytes of all else, and of these rows.
    """
    return max(min(int(count * (limit - others) / spillable), count), 0) if spillable else count


def photo_bytes(images: ImageStore, device: torch.device) -> int:
    """Bytes of the photos that a device keeps."""
    return images.planned_bytes if _keeps(images, device) else 0


def largest_view(scene: Scene) -> int:
    """Pixels of the largest photo."""
    return max(camera.image_width * camera.image_height for camera in scene.getTrainCameras())


def _keeps(images: ImageStore, device: torch.device) -> bool:
    return images.keep_on.type == device.type and (images.keep_on.index or 0) == (device.index or 0)
