"""Adaptive density control, the method's own strategy (Kerbl et al. 2023, Section 5.2)."""

import argparse
from typing import Any

from splatting.option import Option, above
from splatting.part import Options, Strategy


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
    ))
    # fmt: on

    @classmethod
    def absolute_gradients(cls, opt: argparse.Namespace) -> bool:
        return opt.absgrad

    def control(self, run: Any) -> Any:
        from splatting.training.adaptive_density import AdaptiveDensityControl

        return AdaptiveDensityControl.of_run(run, run.opt.absgrad_threshold if run.opt.absgrad else None)
