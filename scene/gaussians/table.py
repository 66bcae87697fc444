"""All tensors of a model that have a row per Gaussian, changed together: parameters, Adam's averages, statistics."""

from collections.abc import Callable, Iterable, MutableMapping
from typing import Any

import torch
from torch import Tensor, nn

from groundwork.host.memory import is_out_of_memory
from scene.gaussians.attributes import Rows
from scene.gaussians.spilled import Storage, empty_spilled_as
from scene.gaussians.statistics import PER_ROW

Group = dict[str, Any]  # a parameter group of a torch optimiser: `params`, options, and maybe `name`
States = MutableMapping[Tensor, dict[str, Any]]  # an optimiser's state by parameter
Change = Callable[[Tensor], Tensor]  # of the rows (N, ...) of any tensor


class GaussianTable:
    """The rows of a model and of its optimiser. Nothing else adds, removes or reorders Gaussians.

    model: has a tensor for each of its `_attributes`, an `optimizer` of torch or None, and statistics. Each attribute
    is a group of the optimiser with one parameter; those that it lacks change without averages. Further groups with a
    row per Gaussian change with the others, and the rest, such as the weights of a network, stay as they are. New
    parameters have no gradient.
    """

    def __init__(self, model: Any) -> None:
        """List the tensors of a model that have a row for each Gaussian: those optimised, their states and others."""
        optimizer = model.optimizer
        self._model = model
        self._storage: Storage | None = getattr(model, "storage", None)
        self.optimised: list[Group] = [] if optimizer is None else list(optimizer.param_groups)
        self.states: States = {} if optimizer is None else optimizer.state
        names = {group.get("name") for group in self.optimised}
        self.others: list[Group] = [
            {"name": name, "params": [getattr(model, attribute.field)]}
            for name, attribute in model._attributes.items()
            if name not in names
        ]

    def select(self, indices: Tensor, count: int) -> dict[str, nn.Parameter]:
        """Keep the rows (n,) int64, ascending, of the parameters that have `count`. Returns these by name."""

        def keep(values: Tensor, name: str, _: bool) -> Tensor:
            room = self._storage and self._storage.empty_for(name, values, len(indices))
            return torch.index_select(values, 0, indices, out=room)

        return self._map(self.row_groups(count), keep)

    def append(self, rows: Rows) -> dict[str, nn.Parameter]:
        """Append `rows[name]` (n, ...) to each parameter, with averages of zero. Returns the parameters by name.

        ValueError for a parameter without rows.
        """
        bare = self._model.optimizer is None
        groups = [*self.optimised, *(group for group in self.others if bare or group["name"] in rows)]
        counts = [len(group["params"][0]) for group in groups if group.get("name") in rows]
        count = counts[0] if counts else len(self._model)
        groups = _select_groups(groups, count)
        if lacking := [str(group.get("name")) for group in groups if group.get("name") not in rows]:
            raise ValueError(
                f"no rows are given for {', '.join(lacking)}, which has a row for every Gaussian; "
                "give them to cat_tensors_to_optimizer, or to densification_postfix by name"
            )

        def grow(values: Tensor, name: str, is_state: bool) -> Tensor:
            new = rows[name]
            new = values.new_zeros(len(new), *values.shape[1:]) if is_state else new
            room = self._storage and self._storage.empty_for(name, values, len(values) + len(new))
            return torch.cat((values, new.detach()), out=room)

        params = self._map(groups, grow)
        for name, values in self._columns.items():
            self._columns[name] = torch.cat((values, values.new_zeros(len(rows["xyz"]), *values.shape[1:])))
        return params

    def permute(self, order: Tensor) -> None:
        """Put the rows, with the statistics, into an order (N,) int64: row i becomes what row order[i] was."""
        spills = self._storage is not None
        self.change(lambda values: _permute(values, order, spills), self.row_groups())

    def change(self, change: Change, groups: Iterable[Group]) -> None:
        """Change the rows of groups and of the statistics, one tensor at a time."""
        model = self._model
        self._map(groups, lambda values, *_: change(values))
        for name in PER_ROW:
            values = getattr(model, name, None)  # users delete those that they do not need
            if values is not None:
                setattr(model, name, change(values))
        for name, values in self._columns.items():
            self._columns[name] = change(values)

    @property
    def _columns(self) -> dict[str, Tensor]:
        """Further columns of a model, which one of other code may lack."""
        return getattr(self._model, "columns", {})

    def replace(self, name: str, value: Tensor) -> dict[str, nn.Parameter]:
        """Give a parameter other values, and averages of zero. Returns it by name; {} for a name that is not there."""
        params = {}
        for group in (*self.optimised, *self.others):
            if group.get("name") == name:
                shape = group["params"][0].shape
                zeros = lambda mean, shape=shape: torch.zeros_like(value if mean.shape == shape else mean)  # noqa: E731
                params[name] = self._replace(group, self._put(name, value), zeros)
        return params

    @torch.no_grad()
    def overwrite(self, indices: Tensor, rows: Rows) -> None:
        """Write `rows[name]` (n, ...) over the rows (n,) int64, all different, of each parameter that has some.

        Averages of these rows restart at zero, and gradients are dropped, as they are those of other values.
        """
        for group in self.row_groups():
            (param,) = group["params"]
            if group.get("name") in rows:
                param.index_copy_(0, indices, rows[group["name"]])
            param.grad = None
        self.restart(indices)

    def restart(self, indices: Tensor) -> None:
        """Zero the averages of the rows (n,); step counters and values stay."""
        for group in self.row_groups():
            (param,) = group["params"]
            for mean in self.states.get(param, {}).values():
                if torch.is_tensor(mean) and mean.dim() == param.dim() and len(mean) == len(param):
                    mean.index_fill_(0, indices, 0.0)

    def row_groups(self, count: int | None = None) -> list[Group]:
        """The groups that have a row for each of `count` Gaussians, by default those of the model."""
        return _select_groups([*self.optimised, *self.others], len(self._model) if count is None else count)

    def _map(self, groups: Iterable[Group], change: Callable[[Tensor, str, bool], Tensor]) -> dict[str, nn.Parameter]:
        """Map parameters and averages; `change` takes values, the group's name, and whether they are averages."""
        params = {}
        for group in groups:
            name, old = group.get("name"), group["params"][0].detach()
            value = self._put(name, change(old, name, False))
            del old  # whose memory the averages may need
            params[name] = self._replace(group, value, lambda mean, name=name: change(mean, name, True), takes=True)
        return params

    def _put(self, name: str | None, values: Tensor) -> Tensor:
        """Put values of an attribute where the model keeps them."""
        return self._storage.put(name, values) if self._storage else values

    def _replace(self, group: Group, value: Tensor, change: Change, takes: bool = False) -> nn.Parameter:
        """Swap a group's parameter, with `takes` in the model, too. `change` maps its averages, the state with rows."""
        old, param, name = group["params"][0], nn.Parameter(value.detach()), group.get("name")
        dims, rows = old.dim(), len(old)
        state = self.states.pop(old, None)
        group["params"] = [param]
        if takes:
            self._model._take({name: param})
        del old  # with `takes` nobody has it any more, so the averages find its memory free
        if state is not None:
            self.states[param] = state
            for key, mean in state.items():
                if torch.is_tensor(mean) and mean.dim() == dims and len(mean) == rows:
                    state[key] = self._put(name, change(mean))
        return param


def _select_groups(groups: Iterable[Group], count: int) -> list[Group]:
    return [g for g in groups if len(g["params"]) == 1 and g["params"][0].dim() and len(g["params"][0]) == count]


def _permute(values: Tensor, order: Tensor, spills: bool) -> Tensor:
    """Return values[order]; column by column in the memory of `values` itself where there is too little for all.

    spills: true if the values may be spilled.
    """
    try:
        return torch.index_select(values, 0, order, out=empty_spilled_as(values) if spills else None)
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        for column in values.view(len(values), -1).unbind(1):
            column.copy_(column.index_select(0, order))
        return values


def trainable(values: Tensor) -> Tensor:
    """The same parameter with contiguous values, as the fused kernels need them; a new one if none was given.

    Parameters, and leaves that require a gradient, stay the same objects. Other tensors are detached.
    """
    if not isinstance(values, nn.Parameter) and not (values.is_leaf and values.requires_grad):
        values = nn.Parameter(values.detach())
    if not values.is_contiguous():
        values.data = values.data.contiguous()
    return values
