"""A worked example of a strategy with a value for each Gaussian, which checkpoints keep (tests/test_example.py)."""

from typing import Any

from splatting.option import Option, at_least
from splatting.part import Options, Strategy


class Patient(Strategy):
    """Adaptive density control of Gaussians whose mean gradient was large in several densifications in a row."""

    name = "patient"
    summary = "as adc, but Gaussians grow only after --patience densifications in a row with a large gradient"
    # fmt: off
    options = Options(optimisation=(
        Option("patience", 2, origin="ours", check=at_least(1),
            help="patient: densifications in a row in which a Gaussian's gradient reaches densify_grad_threshold "
                 "before it is cloned or split; 1: as adc"),
    ))
    # fmt: on

    def begin(self, run: Any, state: Any) -> None:
        import torch

        self._model = model = run.gaussians
        # Columns move with their rows; new rows have zeros. `own`: of several processes, each keeps its part.
        started = torch.zeros(len(model), dtype=torch.int32) if state is None else model.shards.own(state)
        model.columns[self.name] = started.to(model.get_xyz.device)

    def control(self, run: Any) -> Any:
        import torch

        from scene.gaussians.density_rules import mean_gradient
        from splatting.training.adaptive_density import AdaptiveDensityControl

        model, name = self._model, self.name

        class Control(AdaptiveDensityControl):
            fusable = True  # it needs no gradient besides the statistics; not inherited

            def densify(self, iteration: int, limit_size: bool) -> None:
                large = mean_gradient(model.xyz_gradient_accum, model.denom) >= self.threshold
                streaks = model.columns[name] = torch.where(large, model.columns[name] + 1, 0)
                model.xyz_gradient_accum[streaks < run.opt.patience] = 0.0  # so they are neither cloned nor split
                super().densify(iteration, limit_size)

        return Control.of_run(run)

    def state(self) -> Any:
        return self._model.shards.whole(self._model.columns[self.name])
