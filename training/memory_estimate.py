"""How much memory a training will want, said before it starts."""

import math
import sys

import torch

from scene import Scene
from scene.gaussian_model import GaussianModel
from utils.host.memory import free_memory, gib

# Bytes beside the parameters, their gradients and two moments. Fitted to the peak memory of forward and backward in
# docs/results/kernels.md (100 thousand to 6 million Gaussians, within 4 %: 106 and 57); the rest is density control's
# statistics, and what the loss keeps of an image.
PER_GAUSSIAN = 106 + 20
PER_PIXEL = 57 + 72
GROWTH = 20  # of small photo scenes in 7,000 iterations: 10- to 100-fold (README); from 100,000 random points, 2-fold


def announce_memory(scene: Scene, gaussians: GaussianModel, max_splats: int) -> None:
    """Print what pictures and Gaussians will take and what is free, and warn, with remedies, of what can't fit.

    max_splats: most Gaussians there may be (0: no limit, then GROWTH times as many as now are looked at).
    """
    images, device = scene.images, gaussians.get_xyz.device
    pixels = max(camera.image_width * camera.image_height for camera in scene.getTrainCameras())
    now = len(gaussians)
    later = max(max_splats, now) if max_splats else GROWTH * now
    why = "--max_num_splats" if max_splats else f"scenes often grow {GROWTH}-fold"
    at_start, at_end = training_bytes(gaussians, now, pixels), training_bytes(gaussians, later, pixels)
    training = f"training {gib(at_start)} with {now:,} Gaussians, {gib(at_end)} with {later:,} ({why})"
    pictures = images.planned_bytes
    together = images.keep_on.type == device.type and (images.keep_on.index or 0) == (device.index or 0)
    if not together:
        room = _announce(images.keep_on, f"pictures {gib(pictures)}", pictures)
        if room < 0:
            _warn(images.keep_on, "all pictures", "set --images_to_load, or lower --resolution (-r)")
        pictures = 0
    room = _announce(device, f"pictures {gib(pictures)}, {training}" if together else training, pictures)
    if room < at_start:
        _warn(device, f"{now:,} Gaussians", "set --images_to_load, or lower --resolution (-r) or --sh_degree")
    elif room < at_end:
        remedy = "set a lower --max_num_splats, or --images_to_load, or lower --resolution (-r) or --sh_degree"
        _warn(device, f"{later:,} Gaussians", remedy)


def _announce(device: torch.device, content: str, pictures: int) -> float:
    """Print one device's line. Returns how many bytes are free beside the pictures, infinite where it is not known."""
    free = free_memory(device)
    print(f"Memory of the {_name(device)}, estimated: {content}; {'?' if free is None else gib(free)} free")
    return math.inf if free is None else free - pictures


def _warn(device: torch.device, what: str, remedy: str) -> None:
    print(f"warning: the memory of the {_name(device)} seems too small for {what}; {remedy}", file=sys.stderr)


def _name(device: torch.device) -> str:
    return "GPU" if device.type == "cuda" else "CPU"


def training_bytes(gaussians: GaussianModel, count: int, pixels: int) -> int:
    """Memory of `count` Gaussians with all that training keeps beside them, and of one view's buffers."""
    values = sum(group["params"][0][:1].numel() for group in gaussians.optimizer.param_groups)
    return count * (4 * 4 * values + PER_GAUSSIAN) + pixels * PER_PIXEL
