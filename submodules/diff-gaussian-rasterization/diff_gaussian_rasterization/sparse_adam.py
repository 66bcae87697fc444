"""The reference's optimiser of Gaussians that steps visible ones only."""

from collections.abc import Iterable

import torch
from torch import Tensor

from diff_gaussian_rasterization.optim import sparse_adam_


class SparseGaussianAdam(torch.optim.Adam):
    """Sparse Adam (Mallick et al. 2024, Taming 3DGS): Adam for visible rows, without bias correction.

    Rows that are not visible keep values and averages exactly. State and state dict have the form of torch's Adam.
    """

    def __init__(self, params: Iterable, lr: float, eps: float) -> None:
        """Take params as torch's Adam does; each group has one parameter (N, ...), of any strides."""
        super().__init__(params, lr=lr, eps=eps)

    @torch.no_grad()
    def step(self, visibility: Tensor, N: int | None = None) -> None:
        """Step the rows of `visibility` (N,) bool in every parameter that has a gradient. N itself is not needed.

        Raises ValueError for a group of several parameters, RuntimeError for a tensor that does not fit.
        """
        for group in self.param_groups:
            if len(group["params"]) != 1:
                raise ValueError(f"SparseGaussianAdam takes one parameter in each group, got {len(group['params'])}")
            (param,) = group["params"]
            if param.grad is None:
                continue
            state = self.state[param]
            if not state:
                state["step"] = torch.zeros((), dtype=torch.float32)  # counts for users; no formula reads it
                state["exp_avg"] = torch.zeros_like(param)
                state["exp_avg_sq"] = torch.zeros_like(param)
            state["step"] += 1
            tensors = param, param.grad, state["exp_avg"], state["exp_avg_sq"], visibility
            sparse_adam_(*tensors, float(group["lr"]), *group["betas"], group["eps"])
