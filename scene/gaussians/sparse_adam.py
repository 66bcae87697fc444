"""Adam that steps only the Gaussians seen in the view of an iteration."""

import torch
from diff_gaussian_rasterization.optim import sparse_adam_
from torch import Tensor

from scene.gaussians.adam import GaussianAdam


class SparseGaussianAdam(GaussianAdam):
    """Sparse Adam (Mallick et al. 2024, Taming 3DGS): GaussianAdam for visible rows, without bias correction.

    Rows that were not seen keep values and averages exactly. State and state dict keep their form. `step` counts the
    steps of the tensor, and no formula uses it.
    """

    @torch.no_grad()
    def step(self, visible: Tensor, N: int | None = None) -> None:
        """Step the rows of `visible` (N,) bool in every parameter that has a gradient.

        Groups that do not have a row per Gaussian are stepped by torch. N: not needed, the reference takes it.
        """
        groups, others = self._groups()
        for group in groups:
            (param,) = group["params"]
            if param.grad is None:
                continue
            if len(param) != len(visible):
                others = [*others, group]
                continue
            state = self.state_of(param)
            state["step"] += 1
            beta1, beta2 = group["betas"]
            columns = self._active_columns.get(group.get("name"), -1) or -1  # 0, yet with a gradient: all
            guard = self.guard.arguments if self.guard else ()
            tensors = param, param.grad, state["exp_avg"], state["exp_avg_sq"], visible
            if part := self.parts.get(group.get("name")):
                tensors, columns = (*part[1:], visible[part.rows]), -1
            sparse_adam_(*tensors, group["lr"], beta1, beta2, group["eps"], columns, *guard)
        if others:
            self._step_by_torch(others)
