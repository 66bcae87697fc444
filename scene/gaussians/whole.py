"""State of a whole model for a checkpoint, from those of all ranks' parts, and the other way round."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from scene.gaussians.checkpoint import State
from scene.gaussians.shards import Shards
from scene.gaussians.statistics import NAMES
from splatting.distributed.gathering import whole
from splatting.distributed.ranks import Ranks


def whole_state(state: State, ranks: Ranks) -> State:
    """The state of a whole model, from those of all ranks' parts. Every rank must call it."""
    if not ranks.several:
        return state
    rows = {name: nn.Parameter(whole(values, ranks)) for name, values in state.rows.items()}
    statistics = replace(state.statistics, **{n: whole(getattr(state.statistics, n), ranks) for n in NAMES})
    every = _by_rows(state.optimizer, lambda values: whole(values, ranks))
    return state._replace(rows=rows, statistics=statistics, optimizer=every)


def own_state(state: State, shards: Shards) -> State:
    """A rank's part of the state of a whole model."""
    if not shards.ranks.several:
        return state
    count = len(state.statistics.denom)
    rows = {name: shards.own(values) for name, values in state.rows.items()}
    statistics = replace(state.statistics, **{n: shards.own(getattr(state.statistics, n)) for n in NAMES})
    own = _by_rows(state.optimizer, lambda values: shards.own(values) if len(values) == count else values)
    return state._replace(rows=rows, statistics=statistics, optimizer=own)


def _by_rows(state_dict: Any, change: Callable[[Tensor], Tensor]) -> Any:
    """A state dict with its averages changed; GaussianAdam.take_state refuses what is none."""
    states = state_dict.get("state") if isinstance(state_dict, dict) else None
    if not isinstance(states, dict) or not all(isinstance(state, dict) for state in states.values()):
        return state_dict
    changed = {
        key: {name: change(value) if torch.is_tensor(value) and value.dim() else value for name, value in state.items()}
        for key, state in states.items()
    }
    return state_dict | {"state": changed}
