"""Agreement of all ranks on what an optimiser keeps besides its averages."""

from typing import TYPE_CHECKING, Any

import torch

if TYPE_CHECKING:
    from scene.gaussians.adaptive import AdaptiveGaussians


def match_optimizer(gaussians: "AdaptiveGaussians") -> None:
    """Give every rank the last one's step counters, for the groups that have a state there, and in that order.

    A rank without Gaussians takes no steps, and the last rank has some if any has. Every rank must call it.
    """
    ranks, optimizer = gaussians.shards.ranks, gaussians.optimizer
    if not ranks.several or optimizer is None:
        return
    params, states = [group["params"][0] for group in optimizer.param_groups], optimizer.state
    make = getattr(optimizer, "state_of", None)
    order = {param: number for number, param in enumerate(states)}
    mine = [number for param in params for number in (order.get(param, -1), _steps(states.get(param, {})))]
    last = ranks.numbers(*mine)[-1].reshape(-1, 2).tolist()
    for place, steps, index in sorted((*numbers, index) for index, numbers in enumerate(last)):
        param = params[index]
        if place < 0 or (param not in states and make is None):
            continue
        state = states.pop(param) if param in states else make(param)
        states.pop(param, None)
        states[param] = state
        if torch.is_tensor(state.get("step")):
            state["step"].fill_(steps)


def _steps(state: dict[str, Any]) -> int:
    return int(state.get("step", 0))
