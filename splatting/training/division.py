"""Division of a model among ranks: from the start where it is large, else once a step takes long.

A step over ranks takes the host some milliseconds for messages. So a small model trains faster in whole on each rank,
without any message: training is deterministic, and all come to the same bytes.
"""

import math
from typing import TYPE_CHECKING

import torch

from scene.images.store import GPU_SHARE
from scene.sleeping import REST
from splatting.distributed.ranks import Ranks
from splatting.host.memory import free_memory
from splatting.host.torchrun import local_size
from splatting.training.iteration import Iteration
from splatting.training.memory_estimate import largest_view, training_bytes

if TYPE_CHECKING:
    from splatting.training.run import Run

# Seconds of a step from which on ranks share it, by kind of device: two GPUs are then 1.25 times as fast as one
# (docs/results/several_gpus.md, XL). Ranks on a CPU share its cores, where the same work on each is never faster.
PAYS = {"cuda": 6e-3, "cpu": 0.0}
FAULT = 1 << 8  # where ranks agree on a signal: this one ends
MOST_WHOLE = 0.5  # of a GPU's memory, which a whole model may take; photos and the division need some, too


def begins_whole(run: "Run", count: int) -> bool:
    """Whether each of several ranks trains a whole model of `count` Gaussians at first. Every rank must call it.

    Each then decodes and keeps all photos, for which there has to be room, too.
    """
    if not run.group.several or not PAYS[run.device.type]:
        return False
    if run.schedule.views > 1 or run.opt.gpu_memory or run.dataset.images_to_load:
        return False
    images = run.scene.images
    on_host = images.keep_on.type == "cpu"
    photos = run.group.size * images.planned_bytes * (local_size() if on_host else 1)
    free = free_memory(images.keep_on)
    photos_fit = free is None or photos <= GPU_SHARE * free
    return not run.group.anyone(not photos_fit or _is_tight(run, count))


def say_whole(run: "Run") -> None:
    """Print that each rank trains a whole model, and why."""
    pays = f"{1000 * PAYS[run.device.type]:g} ms"
    print(f"each of {run.group.size} GPUs trains the whole model: at this size it is faster, until a step takes {pays}")


def _is_tight(run: "Run", count: int) -> bool:
    """Whether this rank's GPU has little memory for so many Gaussians."""
    if run.device.type == "cpu":
        return False
    needed = training_bytes(run.gaussians, count, largest_view(run.scene))
    return needed > MOST_WHOLE * torch.cuda.mem_get_info(run.device)[1]


def all_failed(run: "Run") -> bool:
    """Let a rank that has to end wait for the others' next agreement; whether all have to end for the same reason."""
    return bool((run.group.numbers(FAULT, 0)[:, 0] == FAULT).all())


def shared_seconds(group: Ranks, seconds: float) -> float:
    """The first rank's seconds, on all. A rank that has to end is met here, too, as where ranks agree on a signal."""
    if not group.several:
        return seconds
    found = group.numbers(0, round(1e6 * seconds))
    if (found[:, 0] == FAULT).any():
        group.anyone(False)  # until it is gone
    return int(found[0, 1]) / 1e6


class Division:
    """Finds out when to divide a whole model.

    Steps of the first epoch, which decode photos, do not count. Two intervals in a row have to be slow, so that another
    program's work does not decide.
    """

    def __init__(self, run: "Run") -> None:
        self._run = run
        self._since = run.first_iteration + len(run.scene.getTrainCameras()) - REST, math.inf
        self._took = 0.0

    def pays(self, at: Iteration) -> bool:
        """Whether this rank wants the model divided: any for lack of memory, the first one for the time of a step."""
        run, (iteration, seconds) = self._run, self._since
        if _is_tight(run, len(run.gaussians)):
            return True
        if not run.group.first or at.iteration < iteration + REST:
            return False
        before, self._since = self._took, (at.iteration, run.clock.seconds)
        self._took = (self._since[1] - seconds) / (at.iteration - iteration)
        return min(before, self._took) > PAYS[run.device.type]
