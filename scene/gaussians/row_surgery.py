"""Changes of the rows of per-Gaussian parameters, together with their state in any torch optimiser."""

from collections.abc import Callable, Iterable, MutableMapping
from typing import Any

import torch
from torch import Tensor, nn

from scene.gaussians.host_memory import beside
from splatting.host.memory import is_out_of_memory

_CHUNK = 1 << 16  # rows moved at a time when memory is too short for all of them

Group = dict[str, Any]  # a parameter group of a torch optimiser: `params`, options, and maybe `name`
States = MutableMapping[Tensor, dict[str, Any]]  # an optimiser's state by parameter


def row_groups(groups: Iterable[Group], count: int) -> list[Group]:
    """The groups that have one parameter with a row for each of `count` Gaussians.

    Others, such as the weights of a network, are not of Gaussians.
    """
    return [g for g in groups if len(g["params"]) == 1 and g["params"][0].dim() and len(g["params"][0]) == count]


def append_rows(groups: list[Group], states: States, rows: dict[str, Tensor]) -> dict[str, nn.Parameter]:
    """Append `rows[name]` (n, ...) to the parameter of each group, with averages of zero.

    groups: of `row_groups`. Returns the new parameters by name, without gradient. ValueError for a group without rows.
    When memory runs out, no group keeps any of the new rows.
    """
    lacking = [str(group.get("name")) for group in groups if group.get("name") not in rows]
    if lacking:
        raise ValueError(
            f"no rows are given for {', '.join(lacking)}, which has a row for every Gaussian; "
            "give them to cat_tensors_to_optimizer, or to densification_postfix by name"
        )
    count = len(groups[0]["params"][0]) if groups else 0

    def grow(values: Tensor, name: str, is_state: bool) -> Tensor:
        new = rows[name]
        return torch.cat((values, values.new_zeros(len(new), *values.shape[1:]) if is_state else new))

    try:
        return map_rows(groups, states, grow)
    except (MemoryError, RuntimeError) as error:
        if is_out_of_memory(error):
            map_rows(groups, states, lambda values, *_: values[:count])
        raise


def keep_rows(groups: list[Group], states: States, indices: Tensor) -> dict[str, nn.Parameter]:
    """Keep the rows of `indices` (n,) int64, ascending, in every group. Returns the parameters, without gradient.

    When memory runs out, the rows are moved within their own memory, and the error is raised afterwards.
    """
    errors = []

    def select(values: Tensor, *_: object) -> Tensor:
        try:
            return beside(values, values.index_select(0, indices))
        except (MemoryError, RuntimeError) as error:
            if not is_out_of_memory(error):
                raise
            errors.append(error)
            return _move_up(values, indices)

    params = map_rows(groups, states, select)
    if errors:
        raise errors[0]
    return params


def replace_values(group: Group, states: States, value: Tensor) -> nn.Parameter:
    """Give the one parameter of a group a new value, and averages of zero. Returns it, without gradient."""
    old = group["params"][0]
    return _replace(group, states, value, lambda mean: torch.zeros_like(value if mean.shape == old.shape else mean))


def restart_rows(groups: list[Group], states: States, indices: Tensor) -> None:
    """Zero the averages of rows (n,) in every group; step counters and values stay."""
    for group in groups:
        (param,) = group["params"]
        for mean in states.get(param, {}).values():
            if torch.is_tensor(mean) and mean.dim() == param.dim() and len(mean) == len(param):
                mean.index_fill_(0, indices, 0.0)


@torch.no_grad()
def overwrite_rows(groups: list[Group], states: States, indices: Tensor, rows: dict[str, Tensor]) -> None:
    """Write `rows[name]` (n, ...) over the rows of `indices` (n,) int64, all different, of each group that has some.

    groups: of `row_groups`. Averages of these rows restart at zero in every group, and gradients are dropped, as they
    are those of other values.
    """
    for group in groups:
        (param,) = group["params"]
        if group.get("name") in rows:
            param.index_copy_(0, indices, rows[group["name"]])
        param.grad = None
    restart_rows(groups, states, indices)


def map_rows(
    groups: list[Group], states: States, change: Callable[[Tensor, str, bool], Tensor]
) -> dict[str, nn.Parameter]:
    """Map all parameters and averages; `change` takes values, the group's name, and whether they are averages.

    Returns the new parameters by name, without gradient.
    """
    params = {}
    for group in groups:
        name = group.get("name")
        old = group["params"][0].detach()
        value = beside(old, change(old, name, False))
        params[name] = _replace(group, states, value, lambda mean, name=name: change(mean, name, True))
    return params


def _replace(group: Group, states: States, value: Tensor, change: Callable[[Tensor], Tensor]) -> nn.Parameter:
    """Swap a group's parameter. `change` maps its averages, the state with a row per Gaussian; step counters stay."""
    old, param = group["params"][0], nn.Parameter(value.detach())
    if old in states:
        state = states[old]
        for key, mean in state.items():
            # Longer than the parameter: appended just before memory ran out, and now to be cut again.
            if torch.is_tensor(mean) and mean.dim() == old.dim() and len(mean) >= len(old):
                state[key] = beside(mean, change(mean))
        states[param] = states.pop(old)
    group["params"] = [param]
    return param


def _move_up(values: Tensor, indices: Tensor) -> Tensor:
    """values[indices] for ascending indices, in the memory of `values` itself."""
    for start in range(0, len(indices), _CHUNK):
        part = indices[start : start + _CHUNK]
        values[start : start + len(part)] = values.index_select(0, part)  # later parts read rows further down
    return values[: len(indices)]
