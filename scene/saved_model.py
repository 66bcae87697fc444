"""The saves of a model folder: the PLYs of iterations, and checkpoints, which an ended training may leave alone.

The SH degree is that of the file, not of cfg_args, because the last save may leave bands out.
"""

import argparse
import os
import re
from pathlib import Path

from scene.gaussian_model import GaussianModel
from scene.gaussians.checkpoint import extra_state, load_checkpoint, unpack
from scene.gaussians.finite import warn_of_undrawn
from scene.gaussians.morton import sort_scattered
from scene.gaussians.ply import read_ply
from scene.scene import Scene, registry_of_parts
from utils.system_utils import UserError, saved_iterations, saved_ply

_CHECKPOINT = re.compile(r"chkpnt(\d+)\.pth")


def saves_in(folder: Path) -> dict[int, Path]:
    """Saved iterations of a model folder: their PLY, or their checkpoint where there is none."""
    matches = [(_CHECKPOINT.fullmatch(path.name), path) for path in sorted(folder.glob("chkpnt*.pth"))]
    saves = {int(match[1]): path for match, path in matches if match and path.is_file()}
    plys = ((n, saved_ply(folder, n)) for n in saved_iterations(folder / "point_cloud"))
    return saves | {n: path for n, path in plys if path.is_file()}


def find_save(model_path: str | os.PathLike, iteration: int) -> tuple[int, Path]:
    """The iteration, -1: the newest one, and its PLY or checkpoint. UserError if the folder has no save of it."""
    folder = Path(model_path)
    saves = saves_in(folder)
    if not saves:
        raise UserError(f"no saved model in {folder}; train it first, or name its folder by -m")
    if iteration != -1 and iteration not in saves:
        there = ", ".join(map(str, sorted(saves)))
        raise UserError(f"iteration {iteration} was never saved in {folder}; give one of {there}")
    found = max(saves) if iteration == -1 else iteration
    return found, saves[found]


def read_model(path: Path, sh_degree: int | None = None) -> GaussianModel:
    """The Gaussians of a PLY or checkpoint, opened once; all SH bands are active.

    sh_degree: that the file must have, None: any. UserError as from read_ply and load_checkpoint.
    """
    if path.suffix == ".pth":
        capture, _ = load_checkpoint(path)
        degree = _find_degree(capture[3].shape[1])  # of f_rest
        gaussians = GaussianModel(degree if sh_degree is None else sh_degree)
        # UserError for a part that is gone: it may have changed what is drawn.
        registry_of_parts().states_in(extra_state(capture))
        rows = unpack(capture, gaussians._attributes, gaussians.max_sh_degree).rows
    else:
        rows = read_ply(path, sh_degree)
        gaussians = GaussianModel(_find_degree(rows["f_rest"].shape[1]))
    warn_of_undrawn(rows, path)
    gaussians.take_whole(rows)
    gaussians.active_sh_degree = gaussians.max_sh_degree
    return gaussians


def _find_degree(coefficients: int) -> int:
    """SH degree of so many coefficients above band 0."""
    return round((coefficients + 1) ** 0.5) - 1


def load_saved(options: argparse.Namespace, iteration: int, sh_degree: int | None = None) -> Scene:
    """Scene of the model options, whose `gaussians` are those of a saved iteration, -1: the newest one.

    Rows that are in no order in space are sorted, which draws faster. sh_degree: degree that the file must have, None:
    any. UserError as from Scene and the functions above.
    """
    iteration, path = find_save(options.model_path, iteration)
    gaussians = read_model(path, sh_degree)
    sort_scattered(gaussians)
    scene = Scene(options, gaussians, load_iteration=iteration, shuffle=False, start=False)
    print(f"Loading trained model at iteration {iteration}" + (f" from {path}" if path.suffix == ".pth" else ""))
    scene.load_parts(options)
    return scene
