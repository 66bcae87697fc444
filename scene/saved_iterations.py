"""Saved iterations of a model folder."""

import os
from pathlib import Path

from utils.system_utils import UserError, saved_iterations, searchForMaxIteration


def saved_ply(model_path: str | os.PathLike, iteration: int | str) -> Path:
    """The PLY of an iteration in a model folder."""
    return Path(model_path) / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"


def find_iteration(model_path: str | os.PathLike, iteration: int) -> int:
    """The iteration, -1: the last one saved. UserError if a model folder has no save of it."""
    folder = Path(model_path) / "point_cloud"
    last = searchForMaxIteration(folder)
    if iteration == -1:
        return last
    if not saved_ply(model_path, iteration).is_file():
        saved = ", ".join(map(str, saved_iterations(folder)))
        raise UserError(f"iteration {iteration} was never saved in {folder}; give one of {saved}")
    return iteration
