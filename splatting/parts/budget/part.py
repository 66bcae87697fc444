"""Growth to a given number of Gaussians, where the training views' error is."""

from typing import Any

from splatting.option import Option, within
from splatting.part import Options, Strategy


class Budget(Strategy):
    """Removes useless Gaussians and adds others, up to a number. In a given time it is best in most cases."""

    name = "budget"
    summary = (
        "grows to --max_num_splats Gaussians where the error is largest (0: one for 64 training pixels, 100,000 to "
        "1,000,000)"
    )
    removes = True
    # fmt: off
    options = Options(optimisation=(
        Option("opacity_decay", 0.98, origin="ours", check=within(0.5, 1),
            help="budget: factor of all opacities after each densification, so that unneeded Gaussians fade; 1: off"),
        Option("prune_opacity", 0.005, origin="ours, and adaptive density control's", check=within(0, 0.5),
            help="budget: remove Gaussians of a lower opacity, every --densification_interval steps"),
    ))
    # fmt: on

    @classmethod
    def best_in(cls, seconds: float, run: Any) -> bool:
        return True

    def control(self, run: Any) -> Any:
        from splatting.parts.budget.control import BudgetControl

        return BudgetControl(run)
