"""Estimate of the memory that a training needs, printed before it starts if that is much of what is free."""

import math
import sys

import torch

from scene import Scene
from scene.gaussian_model import GaussianModel
from scene.images.store import ImageStore
from scene.spilled_model import SpilledGaussians
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
# Part of the Gaussians that a view is taken to see, for what --spill keeps on the GPU only of those in view: that of a
# large scene, which is what it is for.
SEEN = 0.25
GROWTH = 20  # photo scenes grow 10- to 100-fold in 7,000 iterations (docs/results/training.md), random points 2-fold
_REMEDY = "--images_to_load, or lower --resolution (-r) or --sh_degree"


LITTLE = 0.1  # of what is free, of which nobody has to know


def announce_memory(
    scene: Scene, gaussians: GaussianModel, max_splats: int, absolute: bool = False, size: int = 1
) -> None:
    """Print the memory that photos and Gaussians need and what is free; warn, with a remedy, if they do not fit.

    max_splats: limit of the number of Gaussians. Without a limit (0), the estimate is for GROWTH times the number now.
    absolute: with absolute gradients. size: of processes that train together; each says what itself needs.
    """
    images, device = scene.images, gaussians.get_xyz.device
    pixels = max(camera.image_width * camera.image_height for camera in scene.getTrainCameras())
    now = gaussians.gaussian_count
    later = max(max_splats, now) if max_splats else GROWTH * now
    why = "--max_num_splats" if max_splats else f"scenes often grow {GROWTH}-fold"
    per_rank = [-(-count // size) for count in (now, later)]
    at_start, at_end = (training_bytes(gaussians, count, pixels, absolute) for count in per_rank)
    training = f"{later:,} Gaussians ({why}) {gib(at_end)}"
    each = f" for each of {size} processes" if size > 1 else ""
    pictures = images.planned_bytes
    photos = f"photos {gib(pictures)}"
    if images.limit:
        photos += f" (--images_to_load keeps {images.limit:,} of {images.planned:,} decoded images)"
    if isinstance(gaussians, SpilledGaussians) and device.type == "cuda":
        _announce_host(images, spilled_bytes(gaussians, per_rank[1]), f"{later:,} Gaussians", each)
    together = images.keep_on.type == device.type and (images.keep_on.index or 0) == (device.index or 0)
    if not together:
        room = _announce(images.keep_on, photos + each, pictures, pictures)
        if room < 0:
            _warn(images.keep_on, "all photos", "set --images_to_load, or lower --resolution (-r)")
        pictures = 0
    room = _announce(device, (f"{photos}, {training}" if together else training) + each, pictures, pictures + at_end)
    for count, own, needed, first in (
        (now, per_rank[0], at_start, "set "),
        (later, per_rank[1], at_end, "set a lower --max_num_splats, or "),
    ):
        if room < needed:
            helps = device.type == "cuda" and training_bytes(gaussians, own, pixels, absolute, spill=True) <= room
            spill = "set --spill, or " if helps else ""
            _warn(device, f"{count:,} Gaussians", f"{spill}{first}{_REMEDY}")
            break


def _announce_host(images: ImageStore, needed: int, what: str, each: str) -> None:
    """Print what --spill keeps in the host's memory, besides photos there; warn if it does not fit."""
    host = torch.device("cpu")
    pictures = images.planned_bytes if images.keep_on == host else 0
    room = _announce(host, f"--spill {gib(needed)} with {what}{each}", pictures, pictures + needed)
    if room < needed:
        _warn(host, what, f"set a lower --max_num_splats, or {_REMEDY}")


def _announce(device: torch.device, content: str, pictures: int, needed: int) -> float:
    """Print what one device needs, unless it is little of what is free.

    Return the bytes that are free besides the photos, infinity if that is not known.

    The processes of a host have equal parts of what its CPU has free.
    """
    free, sharing = free_memory(device), local_size() if device.type == "cpu" else 1
    if free is not None:
        free //= sharing
    if free is None or needed > LITTLE * free:
        print(f"{_name(device)} memory: about {gib(needed)} of {'?' if free is None else gib(free)}: {content}")
    return math.inf if free is None else free - pictures


def _warn(device: torch.device, what: str, remedy: str) -> None:
    print(f"warning: the memory of the {_name(device)} seems too small for {what}; {remedy}", file=sys.stderr)


def _name(device: torch.device) -> str:
    return "GPU" if device.type == "cuda" else "CPU"


def training_bytes(
    gaussians: GaussianModel, count: int, pixels: int, absolute: bool = False, spill: bool | None = None
) -> int:
    """Bytes of `count` Gaussians with all that training keeps for them, and of one view's buffers.

    absolute: with absolute gradients. spill: with --spill, on the GPU; None: as the model is.
    """
    sizes = [group["params"][0][:1].numel() for group in gaussians.optimizer.param_groups]
    values = sum(sizes)
    each = 4 * (3 * values + max(sizes))  # no step writes gradients; rows change in one tensor after the other
    if isinstance(gaussians, SpilledGaussians) if spill is None else spill:
        bands = _bands(gaussians)
        # All rows: the other values, and how many steps were taken. Rows in view: bands and averages, of this view and
        # the next, and one of the three once more while they are joined; gradients; copies of the other values.
        each = 4 * 4 * (values - bands) + 4 + int(SEEN * 4 * ((3 + 3 + 1 + 1) * bands + 2 * (values - bands)))
    return count * (each + PER_GAUSSIAN + absolute * PER_ABSOLUTE) + pixels * PER_PIXEL


def spilled_bytes(gaussians: GaussianModel, count: int) -> int:
    """Bytes of `count` Gaussians in the host's memory with --spill: bands above 0 and two averages of them."""
    return count * 4 * 3 * _bands(gaussians)


def _bands(gaussians: GaussianModel) -> int:
    """Values of a Gaussian that --spill keeps in the host's memory."""
    return 3 * ((gaussians.max_sh_degree + 1) ** 2 - 1)
