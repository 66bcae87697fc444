"""Adam over the tensors of a Gaussian model, whose state follows as Gaussians are added and removed."""

import math
from collections.abc import Callable
from typing import Any

import torch
from diff_gaussian_rasterization.optim import adam_
from torch import Tensor, nn

from utils.host.memory import is_out_of_memory

_CHUNK = 1 << 16  # rows moved at a time when memory is too short for all of them


class StepGuard:
    """Stops all optimisers at the first iteration whose loss or whose step is not finite.

    In that iteration, a value whose gradient or step is not finite keeps its value. Its exp_avg becomes NaN as a
    mark, which GaussianAdam.take_marks removes. All other values take their step. In later iterations no value does.
    The flag stays on the device, and only `stopped_in` waits for it.
    """

    def __init__(self, device: torch.device | str) -> None:
        self._stopped = torch.zeros(1, dtype=torch.int64, device=device)
        self.arguments: tuple = ()  # the operators' last arguments

    def watch(self, iteration: int, loss: Tensor) -> None:
        """Take the scalar loss of an iteration (from 1), before its step."""
        self.arguments = (loss, self._stopped, iteration)

    def stopped_in(self) -> int:
        """The iteration that stopped the optimisers, 0 as long as none did. Waits for the device."""
        return int(self._stopped)


class GaussianAdam(torch.optim.Adam):
    """torch.optim.Adam with one parameter (N, ...) per named group, and the same bits for any number of threads.

    State and state dict have torch's form (step, exp_avg, exp_avg_sq), so checkpoints of both can be exchanged. Step
    hooks are never called: torch's wrapper for them takes as long as the step itself. guard: see StepGuard.
    """

    guard: StepGuard | None = None

    def __init__(self, groups: list[dict], eps: float = 1e-15) -> None:
        """Take groups: dicts with `params` (a list of one Parameter), `lr` and `name`."""
        super().__init__(groups, lr=0.0, eps=eps)
        self._active_columns: dict[str, int] = {}

    def set_active_columns(self, name: str, columns: int) -> None:
        """Promise that only the first `columns` values of each row of this group ever had a gradient.

        Adam's step for the others changes no bit, as averages and gradient are zero, so it is left out. A group with no
        active columns gets no gradient; its step counter advances with f_dc's.
        """
        self._active_columns[name] = columns

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:
        """Step every parameter that has a gradient; the others keep their values and step counters.

        Each group has its own learning rate; betas and eps are the optimiser's.
        """
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        rates, columns, tensors = [], [], []
        params = {group["name"]: group["params"][0] for group in self.param_groups}
        for group in self.param_groups:
            (param,) = group["params"]
            active = self._active_columns.get(group["name"], -1)
            if active != 0:
                stepped, gradient = param.grad is not None, param.grad
            else:
                # Nothing was rendered from this group. With no columns to read, its values can stand in for a gradient.
                stepped, gradient = params["f_dc"].grad is not None and param.numel() > 0, param
            if stepped:
                state = self._state_of(param)
                tensors.append((param, gradient, state["exp_avg"], state["exp_avg_sq"], state["step"]))
                rates.append(group["lr"])
                columns.append(active)
        if tensors:
            lists, guard = map(list, zip(*tensors, strict=True)), self.guard.arguments if self.guard else ()
            adam_(*lists, rates, *self.defaults["betas"], self.defaults["eps"], columns, *guard)
        return loss

    step.hooked = True  # keeps torch from wrapping it

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Drop the gradients, or zero them."""
        if not set_to_none:
            return super().zero_grad(set_to_none=False)
        for group in self.param_groups:
            group["params"][0].grad = None

    def take_marks(self) -> dict[str, Tensor]:
        """Rows (n,), by group, of the values whose step a guard held back; their averages restart at zero."""
        rows = {}
        for group in self.param_groups:
            state = self.state.get(group["params"][0])
            if not state:
                continue
            marked = state["exp_avg"].isnan()
            if marked.any():
                rows[group["name"]] = marked.reshape(len(marked), -1).any(dim=1).nonzero().reshape(-1)
                for moment in ("exp_avg", "exp_avg_sq"):
                    state[moment].masked_fill_(marked, 0.0)
        return rows

    def rewind(self, steps: int) -> None:
        """Reduce the step counters by the steps that a guard held back."""
        for state in self.state.values():
            state["step"] = (state["step"] - steps).clamp_min(0)

    def _state_of(self, param: Tensor) -> dict[str, Tensor]:
        state = self.state[param]
        if not state:
            state["step"] = torch.zeros((), dtype=torch.float32)
            state["exp_avg"] = torch.zeros_like(param)
            state["exp_avg_sq"] = torch.zeros_like(param)
        return state

    def take_state(self, state_dict: Any) -> list[str]:
        """Take Adam's averages and the step counters of a state dict; the groups keep their options.

        Returns the names of the groups that the state dict has none for. ValueError that says what does not fit, unless
        it is the state dict of the same groups.
        """
        own = self.state_dict()["param_groups"]
        try:
            state, groups = dict(state_dict["state"]), list(state_dict["param_groups"])
            names, keys = [group["name"] for group in groups], [list(group["params"]) for group in groups]
        except (TypeError, ValueError, KeyError, IndexError) as error:
            raise ValueError("it is not the state of an optimiser") from error
        if names != [group["name"] for group in own] or any(len(params) != 1 for params in keys):
            raise ValueError("its groups are different")
        taken = {}
        for group, mine, (key,) in zip(self.param_groups, own, keys, strict=True):
            if key in state:
                taken[mine["params"][0]] = _fitting(state[key], group["params"][0], group["name"])
        super().load_state_dict({"state": taken, "param_groups": own})
        return [group["name"] for group in self.param_groups if group["params"][0] not in self.state]

    def append_rows(self, rows: dict[str, Tensor]) -> dict[str, nn.Parameter]:
        """Append `rows[name]` (n, ...) to each group, with averages of zero. Returns the parameters, without gradient.

        When memory runs out, no group keeps any of the new rows.
        """
        count = len(self.param_groups[0]["params"][0])

        def grow(values: Tensor, name: str, is_moment: bool) -> Tensor:
            return torch.cat((values, torch.zeros_like(rows[name]) if is_moment else rows[name]))

        try:
            return self._change_rows(grow)
        except (MemoryError, RuntimeError) as error:
            if is_out_of_memory(error):
                self._change_rows(lambda values, *_: values[:count])
            raise

    def keep_rows(self, indices: Tensor) -> dict[str, nn.Parameter]:
        """Keep the rows of `indices` (n,) int64, ascending, in every group. Returns the parameters, without gradient.

        When memory runs out, the rows are moved within their own memory, and the error is raised afterwards.
        """
        errors = []

        def select(values: Tensor, *_: object) -> Tensor:
            try:
                return values.index_select(0, indices)
            except (MemoryError, RuntimeError) as error:
                if not is_out_of_memory(error):
                    raise
                errors.append(error)
                return _move_up(values, indices)

        params = self._change_rows(select)
        if errors:
            raise errors[0]
        return params

    def _change_rows(self, change: Callable[[Tensor, str, bool], Tensor]) -> dict[str, nn.Parameter]:
        """Map all parameters and averages; `change` takes values, the group's name, and whether they are averages."""
        params = {}
        for group in self.param_groups:
            value = change(group["params"][0].detach(), group["name"], False)
            params[group["name"]] = self._replace(group, value, lambda moment, name: change(moment, name, True))
        return params

    def reset(self, name: str, value: Tensor) -> nn.Parameter:
        """Give one group a new value and averages of zero. Returns the new parameter, without gradient."""
        (group,) = (group for group in self.param_groups if group["name"] == name)
        return self._replace(group, value, lambda moment, _: torch.zeros_like(moment))

    def _replace(self, group: dict, value: Tensor, change: Callable[[Tensor, str], Tensor]) -> nn.Parameter:
        """Swap a group's parameter; `change` maps its averages, and the step counter stays."""
        param = nn.Parameter(value.requires_grad_(True))
        old = group["params"][0]
        if self.state.get(old):
            for key in ("exp_avg", "exp_avg_sq"):
                self.state[old][key] = change(self.state[old][key], group["name"])
            self.state[param] = self.state.pop(old)
        group["params"] = [param]
        return param


def _move_up(values: Tensor, indices: Tensor) -> Tensor:
    """values[indices] for ascending indices, in the memory of `values` itself."""
    for start in range(0, len(indices), _CHUNK):
        part = indices[start : start + _CHUNK]
        values[start : start + len(part)] = values.index_select(0, part)  # later parts read rows further down
    return values[: len(indices)]


def _fitting(entry: Any, param: Tensor, name: str) -> dict[str, Tensor]:
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
    return {
        "step": torch.tensor(step, dtype=torch.float32),
        "exp_avg": entry["exp_avg"],
        "exp_avg_sq": entry["exp_avg_sq"],
    }
