"""Adam and sparse Adam over the tensors of a Gaussian model."""

import math
import sys
from collections.abc import Callable
from operator import itemgetter
from types import FunctionType
from typing import Any

import groundwork.host.extensions  # noqa: F401  isort: skip  (before the extensions)
import torch
from diff_gaussian_rasterization.optim import adam_, sparse_adam_
from torch import Tensor
from torch.optim.optimizer import _global_optimizer_post_hooks, _global_optimizer_pre_hooks

from scene.gaussians.spilled import spilled_as, zeros_spilled_as
from scene.gaussians.table import Group

# Options of a group that the kernel takes from the optimiser's defaults, or does not know.
_common = itemgetter("betas", "eps", "weight_decay", "amsgrad", "maximize", "capturable", "differentiable", "fused")


class StepGuard:
    """Stops all optimisers at the first iteration whose loss or step is not finite.

    In that iteration, a value whose gradient or step is not finite keeps its value. Its exp_avg becomes NaN as a
    mark, which GaussianAdam.drop_marks removes. All other values take their step. In later iterations no value does.
    The flag `stopped` stays on the device, and only `stopped_in` waits for it.
    """

    def __init__(self, device: torch.device | str) -> None:
        self.stopped = torch.zeros(1, dtype=torch.int64, device=device)
        self.arguments: tuple = ()  # the operators' last arguments

    def watch(self, iteration: int, loss: Tensor) -> None:
        """Take the scalar loss of an iteration (from 1), before its step."""
        self.arguments = (loss, self.stopped, iteration)

    def stopped_in(self) -> int:
        """The iteration that stopped the optimisers, 0 as long as none did. Waits for the device."""
        return int(self.stopped)


class GaussianAdam(torch.optim.Adam):
    """torch.optim.Adam with one parameter (N, ...) per named group, and the same bits for any number of threads.

    State and state dict have torch's form (step, exp_avg, exp_avg_sq), so checkpoints of both can be exchanged.
    guard: see StepGuard. Groups that the kernel cannot step are stepped by torch, unguarded: several parameters, or
    another dtype, device, betas, eps or further option than the optimiser's. Groups may change between any two steps.
    rows: (N,) bool, those that take the next step, None: all.
    """

    guard: StepGuard | None = None
    rows: Tensor | None = None
    _any_strides = False  # of the parameters that the kernel's call takes

    def __init__(self, groups: list[dict], eps: float = 1e-15) -> None:
        """Take groups: dicts with `params` (a list of one Parameter), `lr` and `name`."""
        super().__init__(groups, lr=0.0, eps=eps)
        self._active_columns: dict[str, int] = {}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take a state dict, or become a copy; copies know of no inactive columns."""
        super().__setstate__(state)
        self.__dict__.setdefault("_active_columns", {})

    def add_param_group(self, param_group: Group) -> None:
        """Add a group, as torch does."""
        undecorated(torch.optim.Adam.add_param_group)(self, param_group)

    def state_dict(self) -> dict[str, Any]:
        """The state in torch's form, sorted: a resumed training writes the same file as one that never ended."""
        found = undecorated(torch.optim.Adam.state_dict)(self)
        return found | {"state": dict(sorted(found["state"].items()))}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take a state dict, as torch does."""
        undecorated(torch.optim.Adam.load_state_dict)(self, state_dict)

    def set_active_columns(self, name: str, columns: int) -> None:
        """Promise that only the first `columns` values of each row of this group ever had a gradient.

        Adam's step for the others changes no bit, as averages and gradient are zero, so it is left out. A group with no
        active columns gets no gradient, and its step counter advances with f_dc's; if it gets one, all columns step.
        """
        self._active_columns[name] = columns

    def step(self, closure: Callable[[], float] | None = None) -> float | None:
        """Step every parameter that has a gradient; the others keep their values and step counters.

        Each group has its own learning rate; betas and eps are the optimiser's.
        """
        # torch has wrapped the step of a subclass, and calls the hooks there.
        if self._has_step_hooks() and type(self).step is GaussianAdam.step:
            return self._hooked_step(closure)
        return self._step(closure)

    step.hooked = True  # keeps torch from wrapping it: its wrapper takes as long as the step itself

    def _has_step_hooks(self) -> bool:
        own = self._optimizer_step_pre_hooks or self._optimizer_step_post_hooks
        return bool(own or _global_optimizer_pre_hooks or _global_optimizer_post_hooks)

    @torch.no_grad()
    def _step(self, closure: Callable[[], float] | None = None) -> float | None:
        """Take a step: by the extension for plain parameter groups, by torch for others. Returns the closure's loss."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        groups, others = self._divide_groups()
        rates, columns, tensors = [], [], []
        for group in groups:
            (param,) = group["params"]
            gradient, active = param.grad, self._active_columns.get(group.get("name"), -1)
            if active == 0:
                if gradient is not None:
                    active = -1
                elif param.numel() and _has_gradient(groups, "f_dc"):
                    # Nothing was rendered from this group. With no columns to read, its values can stand in for a
                    # gradient.
                    gradient = param
            if gradient is not None:
                state = self.state_of(param)
                tensors.append((param, gradient, state["exp_avg"], state["exp_avg_sq"], state["step"]))
                rates.append(group["lr"])
                columns.append(active)
        if tensors:
            lists, guard = map(list, zip(*tensors, strict=True)), self.guard.arguments if self.guard else ()
            adam_(
                *lists,
                rates,
                *self.defaults["betas"],
                self.defaults["eps"],
                columns,
                *(guard or (None, None, 0)),
                self.rows,
            )
        if others:
            self._step_by_torch(others)
        return loss

    _hooked_step = torch.optim.Optimizer.profile_hook_step(_step)

    def _divide_groups(self) -> tuple[list[Group], list[Group]]:
        """The groups that the kernel steps, each of one contiguous parameter of the same kind, and those left to torch.

        Decided anew in every step, in some microseconds, as anyone may change a group.
        """
        by_kernel, by_torch, kind, options = [], [], None, _common(self.defaults)
        for group in self.param_groups:
            params = group["params"]
            own = self._find_kind(params[0]) if len(params) == 1 and _common(group) == options else None
            kind = own if kind is None else kind
            (by_torch if own is None or own != kind else by_kernel).append(group)
        return by_kernel, by_torch

    def _find_kind(self, param: Tensor) -> tuple[torch.dtype, torch.device] | None:
        """Dtype and device of a parameter, None for one of a dtype or layout that the kernel does not take."""
        by_kernel = param.dtype == torch.float32 or (param.dtype == torch.float64 and not param.is_cuda)
        fits = by_kernel and param.dim() > 0 and (self._any_strides or param.is_contiguous())
        return (param.dtype, param.device) if fits else None

    def _step_by_torch(self, groups: list[Group]) -> None:
        """Take a step of torch.optim.Adam on some parameter groups only, without calling the hooks again."""
        step = torch.optim.Adam.step
        if getattr(step, "hooked", False):  # once there was an Adam, torch's wrapper, which calls the hooks
            step = step.__wrapped__
        every, self.param_groups = self.param_groups, groups
        try:
            step(self)
        finally:
            self.param_groups = every

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Drop the gradients, or zero them."""
        if not set_to_none:
            return undecorated(torch.optim.Adam.zero_grad)(self, set_to_none=False)
        for group in self.param_groups:
            for param in group["params"]:
                param.grad = None

    def drop_marks(self) -> None:
        """Restart the mean gradient of the values whose step a guard held back."""
        for group in self._divide_groups()[0]:
            if state := self.state.get(group["params"][0]):
                state["exp_avg"].nan_to_num_(0.0)

    def rewind(self, steps: int) -> None:
        """Reduce the step counters by steps that were counted and not taken."""
        for group in self._divide_groups()[0]:
            if state := self.state.get(group["params"][0]):
                state["step"] = (state["step"] - steps).clamp_min(0)

    def set_beta2(self, beta2: float) -> None:
        """Take another decay of the averages of squared gradients from the next step on."""
        self.defaults["betas"] = self.defaults["betas"][0], beta2
        for group in self.param_groups:
            group["betas"] = self.defaults["betas"]

    def active_columns(self, name: str) -> int:
        """The number of columns that step (`set_active_columns`), -1: all of them."""
        return self._active_columns.get(name, -1)

    def steps_all_by_kernel(self) -> bool:
        """Tell whether the kernel steps every group, and no hook waits for a step."""
        return not self._has_step_hooks() and not self._divide_groups()[1]

    def state_of(self, param: Tensor) -> dict[str, Tensor]:
        """Step counter and averages of a parameter, zero before its first step, and contiguous."""
        state = self.state[param]
        if not state:
            state["step"] = torch.zeros((), dtype=torch.float32)
            state["exp_avg"], state["exp_avg_sq"] = (zeros_spilled_as(param.detach()) for _ in range(2))
        for key in ("exp_avg", "exp_avg_sq"):
            if not state[key].is_contiguous():  # as a state may be that was loaded
                state[key] = state[key].contiguous()
        return state

    def take_state(self, state_dict: Any) -> list[str]:
        """Take Adam's averages and the step counters of a state dict; the groups keep their options.

        Returns the names of the groups that the state dict has none for. ValueError that says what does not fit, unless
        it is the state dict of the same groups.
        """
        own = self.state_dict()["param_groups"]
        try:
            state, groups = dict(state_dict["state"]), list(state_dict["param_groups"])
            found = [(group.get("name"), [*dict.fromkeys(group["params"])]) for group in groups]
        except (TypeError, ValueError, KeyError, IndexError, AttributeError) as error:
            raise ValueError("it is not the state of an optimiser") from error
        if [(name, len(keys)) for name, keys in found] != [(g.get("name"), len(g["params"])) for g in own]:
            raise ValueError("its groups are different")
        taken = {}
        for group, mine, (name, keys) in zip(self.param_groups, own, found, strict=True):
            for param, index, key in zip(group["params"], mine["params"], keys, strict=True):
                if key in state:
                    taken[index] = _check_state(state[key], param, name)
        undecorated(torch.optim.Adam.load_state_dict)(self, {"state": taken, "param_groups": own})
        return [g.get("name") for g in self.param_groups if any(param not in self.state for param in g["params"])]


class SparseGaussianAdam(GaussianAdam):
    """Sparse Adam (Mallick et al. 2024, Taming 3DGS): GaussianAdam for visible rows, without bias correction.

    Rows that were not seen keep values and averages exactly. State and state dict keep their form. `step` counts the
    steps of the tensor, and no formula uses it.
    """

    _any_strides = True  # torch would step all rows

    @torch.no_grad()
    def step(self, visible: Tensor, N: int | None = None) -> None:
        """Step the rows of `visible` (N,) bool in every parameter that has a gradient.

        Groups that do not have a row per Gaussian are stepped by torch. N: not needed, the reference takes it.
        """
        groups, others = self._divide_groups()
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
            sparse_adam_(*tensors, group["lr"], beta1, beta2, group["eps"], columns, *guard)
        if others:
            self._step_by_torch(others)


def undecorated(method: Callable) -> Callable:
    """Remove the decorator that hides a method of torch's optimisers from torch's compiler, unless that is loaded.

    The decorator, torch._disable_dynamo, imports torch._dynamo, which takes one to five seconds and is useless while
    the compiler is not loaded.
    """
    hidden = isinstance(method, FunctionType) and method.__globals__.get("__name__") == "torch._compile"
    return method.__wrapped__ if hidden and "torch._dynamo" not in sys.modules else method


def _has_gradient(groups: list[Group], name: str) -> bool:
    return any(group.get("name") == name and group["params"][0].grad is not None for group in groups)


def _check_state(entry: Any, param: Tensor, name: str | None) -> dict[str, Tensor]:
    """Adam's state of one parameter, checked against it."""
    if not isinstance(entry, dict) or not {"step", "exp_avg", "exp_avg_sq"} <= entry.keys():
        raise ValueError(f"step, exp_avg or exp_avg_sq of {name} is missing")
    for key in ("exp_avg", "exp_avg_sq"):
        moment = entry[key]
        if not torch.is_tensor(moment) or moment.shape != param.shape or moment.dtype != param.dtype:
            raise ValueError(f"{key} and {name} differ in shape or type")
        if not moment.isfinite().all():
            raise ValueError(f"{key} of {name} is not finite")
    try:
        step = float(entry["step"])  # a tensor; a number where an older torch wrote it
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"step of {name} is not a number") from error
    if not (math.isfinite(step) and step >= 0):
        raise ValueError(f"step of {name} is {step}")
    averages = {
        key: spilled_as(param, value)
        for key, value in entry.items()
        if torch.is_tensor(value) and value.shape == param.shape
    }
    return {"step": torch.tensor(step, dtype=torch.float32), **averages}
