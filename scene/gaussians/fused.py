"""Adam's tensors as the rasterizer's backward takes them, so that it steps the Gaussians itself."""

from typing import Any

import utils.host.extensions  # noqa: F401  isort: skip  (before the extensions)
from torch import Tensor

from scene.gaussian_model import GaussianModel
from scene.gaussians.adam import GaussianAdam
from scene.gaussians.sparse_adam import SparseGaussianAdam

# In the operator's order (gs::Stepped).
_STEPPED = ("xyz", "opacity", "scaling", "rotation", "f_dc", "f_rest")


class FusedAdam:
    """Hands a model's optimiser to `rasterize_vjp_step_`. Make one only if `takes` says so."""

    def __init__(self, gaussians: GaussianModel) -> None:
        self._gaussians = gaussians

    @staticmethod
    def takes(gaussians: GaussianModel) -> bool:
        """Whether the operator steps this model as its own optimiser would.

        It does for a GaussianModel whose activations, getters, attributes and optimiser are ours, one group for each
        attribute, without hooks.
        """
        optimizer = gaussians.optimizer
        return (
            type(gaussians) is GaussianModel
            and gaussians.kernels_activate
            and gaussians.features_are_raw
            and gaussians._attributes.keys() == {*_STEPPED}
            and type(optimizer) in (GaussianAdam, SparseGaussianAdam)
            and optimizer.steps_all_by_kernel()
            and all(_is_plain(gaussians.raw(name)) for name in _STEPPED)
        )

    def arguments(self, observe: bool) -> tuple[Any, ...]:
        """Arguments of the operator from `attributes` on, for the next step. observe: with the statistics."""
        gaussians, optimizer = self._gaussians, self._gaussians.optimizer
        sparse = isinstance(optimizer, SparseGaussianAdam)
        groups = {group["name"]: group for group in optimizer.param_groups}
        attributes, averages, squares, steps, rates, columns = [], [], [], [], [], []
        for place, name in enumerate(_STEPPED):
            active = optimizer.active_columns(name)
            if active == 0 and sparse:
                continue  # it has no gradient, so the sparse optimiser would pass it over
            state = optimizer.state_of(groups[name]["params"][0])
            attributes.append(place)
            averages.append(state["exp_avg"])
            squares.append(state["exp_avg_sq"])
            steps.append(state["step"])
            rates.append(groups[name]["lr"])
            columns.append(active)
        defaults = optimizer.defaults
        seen = gaussians.statistics
        statistics = (seen.max_radii2D, seen.xyz_gradient_accum, seen.denom) if observe else (None, None, None)
        guard = optimizer.guard.arguments if optimizer.guard else ()
        lists = attributes, averages, squares, steps, rates
        return (*lists, *defaults["betas"], defaults["eps"], columns, sparse, *statistics, *guard)


def _is_plain(param: Tensor) -> bool:
    """Whether nobody but the optimiser waits for the parameter's gradient."""
    return param.requires_grad and param.grad is None and not param._backward_hooks
