"""Depth maps as supervision (--depths), as in the newest reference: a loss of inverse depth with a falling weight."""

import argparse
from pathlib import Path
from typing import Any

from torch import Tensor

from scene.cameras import Camera
from scene.dataset_readers import find_reader_replacement
from scene.readers.depth_maps import with_depth_maps
from scene.readers.depth_scale import check_maps
from scene.readers.info import SceneInfo
from scene.readers.scene_folder import kind_of
from splatting.iteration import Iteration, Term
from splatting.part import Needs, Part
from utils.general_utils import get_expon_lr_func
from utils.loss_utils import inverse_depth_loss


class Depths(Part):
    """Finds the depth maps of the training photos, and adds their loss for views whose map is reliable."""

    name = "depths"
    needs = Needs(depth=True, files=True, length=True)

    def dataset(self, info: SceneInfo, args: argparse.Namespace, fresh: bool) -> SceneInfo:
        """Return the dataset with the depth maps of its training views, if it is read to train.

        A saved model is rendered without depth maps, so its dataset stays as it is. So does the dataset of a reader of
        other code, which finds the maps itself. UserError for maps that cannot be used.
        """
        if not fresh or find_reader_replacement(kind_of(args.source_path)):  # which finds the maps itself
            return info
        info = with_depth_maps(info, Path(args.source_path), args.depths)
        check_maps(info, Path(args.source_path, args.depths))
        return info

    def begin(self, run: Any, state: Any) -> None:
        self._schedule, opt = run.schedule, run.opt
        self._unit = 1 / run.gaussians.enlargement  # so that the loss is that of depths as they are drawn
        ends = opt.depth_l1_weight_init, opt.depth_l1_weight_final
        self._weight = get_expon_lr_func(*ends, max_steps=opt.iterations)

    def terms(self, at: Iteration) -> dict[str, Term]:
        weight = self._weight(self._schedule.schedule_step(at.iteration)) if at.camera.depth_reliable else 0.0
        if not weight > 0:
            return {}
        return {"depth": lambda package, mask: weight * self._unit * depth_loss(package["depth"], at.camera, mask)}


def depth_loss(inverse_depth: Tensor, camera: Camera, mask: Tensor | None) -> Tensor:
    """Return the mean absolute difference of an inverse depth from the camera's map, where the map has a value.

    inverse_depth: (1, H, W).
    mask: (1, H, W) bool, pixels that count; None: all.
    """
    target = camera.target_inverse_depth
    if camera.depth_has_gaps:
        mask = target > 0 if mask is None else mask & (target > 0)
    return inverse_depth_loss(inverse_depth, target, camera.columns, mask)
