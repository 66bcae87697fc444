"""A worked example of a strategy with a value for each Gaussian, which checkpoints keep (tests/test_example.py)."""

from typing import Any

import torch

from scene.gaussians.density_rules import mean_gradient
from splatting.features.adc import Adc


class Patient(Adc):
    """Adaptive density control of Gaussians whose mean gradient was large in several densifications in a row."""

    name = "patient"
    fusable = True  # it needs no gradient besides the statistics; not inherited

    @classmethod
    def takes_absolute(cls, opt: Any) -> bool:
        return False  # --absgrad is of adc alone

    def begin(self, run: Any, state: Any) -> None:
        super().begin(run, state)
        self._patience = run.opt.patience
        self._model = model = run.gaussians
        # Columns move with their rows; new rows have zeros. `own`: of several processes, each keeps its part.
        started = torch.zeros(len(model), dtype=torch.int32) if state is None else model.shards.own_rows(state)
        model.columns[self.name] = started.to(model.get_xyz.device)

    def densify(self, iteration: int, limit_size: bool) -> None:
        model = self._model
        large = mean_gradient(model.xyz_gradient_accum, model.denom) >= self.threshold
        streaks = model.columns[self.name] = torch.where(large, model.columns[self.name] + 1, 0)
        model.xyz_gradient_accum[streaks < self._patience] = 0.0  # so they are neither cloned nor split
        super().densify(iteration, limit_size)

    def state(self) -> Any:
        return self._model.shards.gather_whole(self._model.columns[self.name])
