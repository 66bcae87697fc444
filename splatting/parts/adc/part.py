"""Adaptive density control, the method's own strategy (Kerbl et al. 2023, Section 5.2)."""

import argparse
from typing import Any

from splatting.training.option import Option, above, one_of
from splatting.training.part import Options, Strategy


class Adc(Strategy):
    """Clones, splits, prunes and resets."""

    name = "adc"
    summary = "adaptive density control of the 3DGS paper"
    # fmt: off
    options = Options(optimisation=(
        Option("absgrad", False, origin="ours",
            help="adc: densify by absolute gradients of the pixels (AbsGS), which do not cancel out where a large "
                 "Gaussian covers fine detail; --absgrad_threshold then replaces --densify_grad_threshold"),
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
        from splatting.training.adaptive_density import AdaptiveDensityControl

        threshold = run.opt.absgrad_threshold if run.opt.absgrad else None
        return AdaptiveDensityControl.of_run(run, threshold, long_axis=run.opt.split == "long_axis")
