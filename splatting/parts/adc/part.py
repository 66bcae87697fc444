"""Adaptive density control, the method's own strategy (Kerbl et al. 2023, Section 5.2)."""

import argparse
import copy
import sys
from typing import Any

from splatting.training.option import Option, above, one_of
from splatting.training.part import Options, Strategy


class Adc(Strategy):
    """Clones, splits, prunes and resets; where a part needs bright renders, it resets at a given interval alone."""

    name = "adc"
    summary = "adaptive density control, the method's own"
    # fmt: off
    options = Options(optimisation=(
        Option("absgrad", False, origin="ours",
            help="adc: densify by the sum of the pixels' absolute gradients (AbsGS), which do not cancel out where a "
                 "large Gaussian covers fine detail; absgrad_threshold then stands for densify_grad_threshold"),
        Option("absgrad_threshold", 0.0008, origin="ours, as gsplat recommends", check=above(0),
            help="adc: absolute screen-space gradient (per NDC unit) that makes a Gaussian clone or split, with "
                 "--absgrad; lower: more Gaussians"),
        Option("split", "sample", origin="ours", check=one_of("sample", "long_axis"),
            help="adc: where the two children of a split Gaussian are. sample: at random, as by its density, each 1.6 "
                 "times smaller; long_axis: on both sides along its longest axis, which keeps its mean and covariance"),
    ))
    # fmt: on

    @classmethod
    def absolute_gradients(cls, opt: argparse.Namespace) -> bool:
        return opt.absgrad

    def control(self, run: Any) -> Any:
        from scene.gaussians.density_rules import USUAL_RESETS
        from splatting.parts.adc.control import AdaptiveDensityControl

        opt, white = run.opt, run.dataset.white_background
        if any(part.needs.bright for part in run.parts) and opt.opacity_reset_interval == USUAL_RESETS:
            opt, white = copy.copy(opt), False
            opt.opacity_reset_interval = sys.maxsize
        return AdaptiveDensityControl(run.gaussians, opt, white, run.scene.cameras_extent)
