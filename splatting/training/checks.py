"""Checks made before training, so that a hopeless scene fails at once."""

import argparse
import sys

import numpy as np

from scene.gaussian_model import GaussianModel
from scene.gaussians import density_rules as rules
from scene.readers.info import APART, NEAREST, SceneInfo, camera_centers, standing_apart
from splatting.files.listing import some
from splatting.training.density import DensityControl
from splatting.training.schedule.clocked import Clocked
from splatting.training.schedule.pace import Pace
from utils.system_utils import UserError

_SAMPLE = 16  # cameras whose depths are checked
_FEWEST_BEYOND = 0.01  # share of the points in front of them that must lie beyond the nearest depth


def check_scene(info: SceneInfo) -> None:
    """Refuse a scene that cannot be trained (UserError); print where training departs from the dataset's files."""
    _check_scale(info)
    _report_cameras_apart(info)
    if info.offset.any():
        print(
            f"the scene's coordinates are large against its extent: training subtracts {tuple(info.offset.tolist())}, "
            "which model.json keeps; python -m scene.export_world writes the model in the scene's own coordinates"
        )


def _check_scale(info: SceneInfo) -> None:
    """UserError if hardly any point lies beyond the nearest depth that is drawn."""
    cameras = info.train_cameras[:: max(1, len(info.train_cameras) // _SAMPLE)]
    depths = np.concatenate([(info.point_cloud.points @ camera.R + camera.T)[:, 2] for camera in cameras])
    depths = depths[depths > 0]
    if len(depths) and (depths > NEAREST).mean() < _FEWEST_BEYOND:
        middle = float(np.median(depths))
        raise UserError(
            f"the points lie {middle:.2g} units from the cameras, and nothing nearer than {NEAREST} is drawn; scale "
            f"cameras and points of the scene by {10.0 ** np.ceil(np.log10(5 / middle)):g}"
        )


def _report_cameras_apart(info: SceneInfo) -> None:
    """Name the training cameras that the extent leaves out."""
    apart = standing_apart(camera_centers(info.train_cameras))
    if apart.any():
        names = [info.train_cameras[index].image_name for index in apart.nonzero()[0]]
        print(
            f"{len(names)} of {len(apart)} cameras are more than {APART:g} times as far from the middle as the median "
            f"camera ({some(names)}) and are left out of the scene's extent, {info.extent:.3g}; check their "
            "poses",
            file=sys.stderr,
        )


def check_target(target_psnr: float, test_views: int) -> None:
    """Refuse a target for test views that are not there (UserError)."""
    if target_psnr and not test_views:
        raise UserError("--target_psnr needs held-out views to score, and there are none; give --eval")


def check_exposures(gaussians: GaussianModel, train_test_exp: bool, checkpoint: str) -> None:
    """Refuse a checkpoint with exposures that this run would not use (UserError); report the opposite case."""
    if gaussians.exposures.trained and not train_test_exp:
        raise UserError(f"{checkpoint} was trained with --train_test_exp; give that option")
    if train_test_exp and not gaussians.exposures.trained:
        print(f"{checkpoint} has no exposures: all photos start without a correction")


def warn_of_late_reset(opt: argparse.Namespace, white_background: bool, pace: Pace) -> None:
    """Warn if adaptive density control resets opacities so late that the model cannot recover.

    Iterations are those of the run. A run with a time budget does not know them yet: `late_reset` then tells.
    """
    if opt.strategy != "adc" or pace.ends is None:
        return
    last = range(max(1, pace.ends - rules.RECOVERY + 1), pace.ends)
    due = [t for t in last if rules.actions(t, opt, white_background, pace.span(t), pace.stride(t)).reset_opacity]
    if due:
        remedy = "--iterations or --opacity_reset_interval" if pace.ends == pace.length else "--opacity_reset_interval"
        print(
            f"warning: opacities are reset in iteration {due[-1]}, and {pace.ends - due[-1]} iterations are "
            f"too few to recover from that; change {remedy}"
        )


def late_reset(iteration: int, pace: Pace) -> str | None:
    """The warning for a reset in an iteration of a run with a time budget, by its speed; None if it is in time."""
    left = (pace.length - pace.nominal(iteration)) / pace.stride(iteration)
    if not isinstance(pace, Clocked) or left >= rules.RECOVERY:
        return None
    return (
        f"warning: opacities are reset in iteration {iteration}, and about {left:.0f} iterations that are left of "
        "--time_budget are too few to recover from that; raise it, or change --opacity_reset_interval"
    )


def warn_of_fewer(density: DensityControl, opt: argparse.Namespace, count: int, first: int) -> None:
    """Warn if a strategy cannot reach its number of Gaussians in time.

    count: of Gaussians, now; first: the next iteration. Not known of a run with a time budget.
    """
    pace, aim = density.pace, density.most_gaussians
    # The number that mcmc takes where none is given is a limit, nothing to reach.
    if pace.ends is None or (opt.strategy == "mcmc" and not opt.max_num_splats):
        return
    if pace.nominal(first) >= density.ends > 0:
        return  # a resumed run has no say in it any more
    most = density.most_after(count, first, pace.ends)
    if most >= aim:
        return
    if opt.strategy == "mcmc":
        why = f"--mcmc_growth {opt.mcmc_growth:g} adds too few each time; raise it, or lower --densification_interval"
    elif pace.length < density.ends:
        why = f"--densify_until_iter {opt.densify_until_iter} is not before the end; lower it"
    else:
        why = "they at most double each time; lower --densification_interval, or raise --densify_until_iter"
    print(
        f"warning: --strategy {opt.strategy} gets to {most:,} of {aim:,} Gaussians at the most, as {why}",
        file=sys.stderr,
    )
