"""Whether the files that a training still has to write fit on the disk."""

import math
import shutil
from pathlib import Path
from typing import Any

from utils.system_utils import UserError

_OF_PLY = 3  # numbers of a Gaussian besides its own: normals, which are 0
_OF_CHECKPOINT = 3  # the same: statistics of density control. Its own come with Adam's two averages


def little_space(run: Any, sure: int, later: int, first: int) -> str | None:
    """What to say if the saves from iteration `first` on do not fit with `later` Gaussians, before they are written.

    sure: Gaussians that there are at least. UserError if not even one PLY of so many fits.
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
    return (
        f"the disk of {folder} has {_mb(free)} free, and the saves to come take about {_mb(needed)} if there are "
        f"{later:,} Gaussians; free space there in time"
    )


def _mb(count: float) -> str:
    return f"{count / 1e6:,.1f} MB"
