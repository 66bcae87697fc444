"""Checks made before training, so that a hopeless scene fails at once."""

import argparse
import sys

import numpy as np

from scene.gaussian_model import GaussianModel
from scene.gaussians import density_rules as rules
from scene.readers.info import APART, NEAREST, SceneInfo, camera_centers, standing_apart
from utils.files.listing import some
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


def warn_of_late_reset(opt: argparse.Namespace, white_background: bool) -> None:
    """Warn if adaptive density control resets opacities so late that the model cannot recover."""
    if opt.strategy != "adc":
        return
    last = range(max(1, opt.iterations - rules.RECOVERY + 1), opt.iterations)
    late = [t for t in last if rules.actions(t, opt, white_background).reset_opacity]
    if late:
        print(
            f"warning: opacities are reset in iteration {late[-1]}, and {opt.iterations - late[-1]} iterations are "
            "too few to recover from that; change --iterations or --opacity_reset_interval"
        )
