"""Adam's tensors as the rasterizer's backward takes them, so that it steps the Gaussians itself."""

from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple

import groundwork.host.extensions  # noqa: F401  isort: skip  (before the extensions)
from diff_gaussian_rasterization.backend import OPERATORS
from diff_gaussian_rasterization.scene import Scene
from torch import Tensor

from scene.gaussian_model import GaussianModel
from scene.gaussians.adam import GaussianAdam, SparseGaussianAdam
from scene.gaussians.penalty import NO_PENALTY, Penalty

# In the operator's order (gs::Stepped).
_STEPPED = ("xyz", "opacity", "scaling", "rotation", "f_dc", "f_rest")

NOW_WORDS = 23  # int64: what changes from step to step (gs::StepNow)
CAMERA_NUMBERS = 34  # of a camera with a lens; a pinhole has fewer (csrc/math/camera_gradient.h)


class FusedAdam:
    """Passes a model's optimiser, and a penalty, to `apply_gradients_`. Make one only if `takes` is true.

    left_out: attributes that take no step.
    """

    def __init__(self, gaussians: GaussianModel, penalty: Penalty = NO_PENALTY, left_out: Collection[str] = ()) -> None:
        self._gaussians = gaussians
        self._penalty = penalty or NO_PENALTY
        self._left_out = left_out

    @staticmethod
    def takes(gaussians: GaussianModel) -> bool:
        """Tell whether the operator steps this model as the model's own optimiser would.

        True for a GaussianModel whose activations, getters, attributes and optimiser are ours, with one group for each
        attribute and without hooks.
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

    def arguments(self, observe: bool) -> "StepArguments":
        """Return the arguments of the operator for the next step.

        observe: true to add the view to the statistics of density control.
        """
        optimizer, stepping = self._gaussians.optimizer, list(self._list_stepping())
        each = self._penalty.per_value(self._gaussians.gaussian_count)
        *guard, iteration = (optimizer.guard and optimizer.guard.arguments) or (0,)
        return StepArguments(
            [one.state[name] for name in ("exp_avg", "exp_avg_sq") for one in stepping],
            [one.state["step"] for one in stepping],
            self._list_statistics() if observe else (),
            guard,
            [one.attribute for one in stepping],
            [one.rate for one in stepping],
            [*self._list_constants(), each.opacity, each.scale],
            [one.columns for one in stepping],
            self._sparse,
            iteration,
        )

    def apply(
        self,
        scene: Scene,
        source: Sequence[Tensor],
        planes: Sequence[Tensor | None],
        radii: Tensor,
        observe: bool,
        absolute: bool,
        now: Tensor | None,
        camera: Tensor | None = None,
        awake: Tensor | None = None,
    ) -> None:
        """Take a step with the gradients of a view.

        source, planes: what the drawing of the view has kept, and the gradients of its images, in the form that
        `gradients_of` (diff_gaussian_rasterization/ops.py) takes. radii: (N,) int32 pixels. observe, absolute: add the
        view to the statistics, with sums of absolute gradients. now: see `write_now`, None: no recorded step.

        camera: (CAMERA_NUMBERS,) float64 on the Gaussians' device, gets the gradients of the camera's numbers before
        the step. awake: the blocks of Gaussians that do not sleep, from `Sleeping.wake`; None: all.
        """
        gaussians, view, *options = scene.lists
        view = view if awake is None else (*view, awake)
        # By place: names would cost the operator microseconds.
        arguments = source, planes, radii, *self.arguments(observe), now, absolute, camera
        OPERATORS.apply_gradients_(gaussians, view, *options, *arguments)

    def write_now(self, now: Tensor, iteration: int) -> None:
        """Write the numbers of the next step, (NOW_WORDS,) int64 on the CPU, and advance the step counters.

        A step that was recorded with a copy of the numbers on the GPU (`Drawn.step`) then takes the step of
        `iteration`.
        """
        stepping = list(self._list_stepping())
        attributes, steps = [one.attribute for one in stepping], [one.state["step"] for one in stepping]
        rates = [one.rate for one in stepping]
        OPERATORS.step_now_(now, attributes, steps, rates, *self._list_constants(), self._sparse, iteration)

    def places(self) -> tuple[int, ...]:
        """Number of Gaussians, and addresses of all tensors of a step, to detect replaced tensors."""
        tensors = [
            t for one in self._list_stepping() for t in (one.param, one.state["exp_avg"], one.state["exp_avg_sq"])
        ]
        tensors += self._list_statistics()
        return len(self._gaussians), *[tensor.data_ptr() for tensor in tensors]

    @property
    def _sparse(self) -> bool:
        return isinstance(self._gaussians.optimizer, SparseGaussianAdam)

    def _list_constants(self) -> tuple[float, float, float]:
        defaults = self._gaussians.optimizer.defaults
        return (*defaults["betas"], defaults["eps"])

    def _list_statistics(self) -> tuple[Tensor, Tensor, Tensor]:
        statistics = self._gaussians.statistics
        return statistics.max_radii2D, statistics.xyz_gradient_accum, statistics.denom

    def _list_stepping(self) -> Iterator["_Stepping"]:
        """Yield the attributes that take part in the next step, in the operator's order.

        Active columns are the leading values of each row that may have a gradient, such as the SH coefficients up to
        the active degree (`GaussianAdam.set_active_columns`). Sparse Adam passes over an attribute without any; of the
        others, such an attribute's step counter advances.
        """
        optimizer, sparse = self._gaussians.optimizer, self._sparse
        groups = {group["name"]: group for group in optimizer.param_groups}
        for place, name in enumerate(_STEPPED):
            (param,) = groups[name]["params"]
            active = optimizer.active_columns(name)
            if name in self._left_out or not param.numel() or (active == 0 and sparse):
                continue  # it has no gradient, and the optimiser would pass it over
            yield _Stepping(place, param, optimizer.state_of(param), groups[name]["lr"], active)


class StepArguments(NamedTuple):
    """The arguments of `apply_gradients_` for a step, in order; lists have an entry for each attribute that steps."""

    averages: list[Tensor]  # exp_avg of all, then exp_avg_sq
    steps: list[Tensor]  # counters
    statistics: tuple[Tensor, ...]  # max_radii, gradient_sums and views, or none
    guard: list[Tensor]  # loss and stopped, or none
    attributes: list[int]  # places in gs::Stepped
    rates: list[float]
    constants: list[float]  # beta1, beta2, eps, penalties of opacities and of scales
    columns: list[int]  # leading values of each row that step, -1: all
    sparse: bool  # only Gaussians that the view shows step
    iteration: int


class _Stepping(NamedTuple):
    """An attribute that takes part in a step."""

    attribute: int  # its place in gs::Stepped
    param: Tensor
    state: dict[str, Tensor]  # the optimiser's: step, exp_avg, exp_avg_sq
    rate: float  # learning rate
    columns: int  # active ones, -1: all


def _is_plain(param: Tensor) -> bool:
    """Tell whether the operator can step the parameter, and only the optimiser uses its gradient."""
    return param.is_contiguous() and param.requires_grad and param.grad is None and not param._backward_hooks
