"""The registry of the parts of a training (splatting/part.py is their manual): their one order."""

import argparse
from collections.abc import Collection, Iterable, Mapping
from typing import Any

from splatting.features.adc import Adc
from splatting.features.budget import Budget
from splatting.features.depths import Depths
from splatting.features.exposure import Exposure
from splatting.features.mcmc import Mcmc
from splatting.features.ppisp import Ppisp
from splatting.features.refine_poses import RefinePoses
from splatting.features.robust_mask import RobustMask
from splatting.features.sky import Sky
from splatting.features.sparse_depth import SparseDepth
from splatting.features.time_budget import TimeBudget
from splatting.part import Appearance, Part, Strategy
from utils.system_utils import UserError

# With the reason for the place, where there is one.
PARTS: tuple[type[Part], ...] = (
    TimeBudget,
    Exposure,  # adds training views before anything moves them
    RefinePoses,  # its cameras stand right before anything asks where they are
    Depths,
    RobustMask,
    Adc,  # the first strategy is the default
    Mcmc,  # before Budget: where a time is given, the first that is best in it is taken
    Budget,
    Sky,
    SparseDepth,  # the order of the terms of the loss is in the bytes of the model
    Ppisp,
)


def strategies() -> list[type[Strategy]]:
    """Return the strategies of density control; the first is the default."""
    return [part for part in PARTS if issubclass(part, Strategy)]


def strategy_part(name: str) -> Strategy:
    """Make the part of a strategy. UserError for an unknown name, such as one in a file of another program."""
    known = {strategy.name: strategy for strategy in strategies()}
    if name not in known:
        raise UserError(f"there is no strategy {name!r}; give --strategy {' or '.join(known)}")
    return known[name]()


def in_order(parts: Iterable[Part]) -> list[Part]:
    """Sort parts in the order of the registry."""
    names = [part.name for part in PARTS]
    return sorted(parts, key=lambda part: names.index(part.name))


OF_RUN = "sleep", "resume"  # states of a checkpoint that are of no part: blocks that sleep, and new photos
EXPOSURES = "exposures"  # the model's own key of what an appearance has trained
# Of states in checkpoints of 0.3 and before.
_OLD_KEYS = {
    "asleep": "sleep",
    "best": "keep_best",  # which is gone, and refused by this name
    "more_photos": "resume",
    "poses": "refine_poses",
    "residuals": "robust_mask",
    "schedule": "time_budget",
}


def states_in(checkpoint: Mapping[str, Any]) -> dict[str, Any]:
    """Return the states of parts by their names, from the extra state of a checkpoint.

    UserError for a state that belongs to no part.
    """
    kinds = {part.kind: part.name for part in PARTS if issubclass(part, Appearance)}
    renamed = _OLD_KEYS | {EXPOSURES: kinds.get(checkpoint.get(EXPOSURES, {}).get("kind", "affine"), EXPOSURES)}
    named = {renamed.get(key, key): state for key, state in checkpoint.items()}
    if unknown := sorted(map(str, named.keys() - {part.name for part in PARTS}.union(OF_RUN))):
        raise UserError(
            f"the checkpoint has a state of {unknown[0]}, which this code does not have; use the code that wrote it, "
            "or start a new training from its PLY by --init_ply"
        )
    return {name: state for name, state in named.items() if state is not None}


def chosen(given: argparse.Namespace, states: Collection[str] = (), iteration: int = 0) -> list[Part]:
    """Make the parts that options ask for, and those that a state in a checkpoint brings in, in their order.

    A strategy joins a run later (splatting/run.py).

    given: options of all groups.
    states: names of the parts that have a state in the checkpoint.
    iteration: iteration of the checkpoint.
    """
    others = [part for part in PARTS if not issubclass(part, Strategy)]
    return [
        part()
        for part in others
        if part.asked_by(given) or (part.name in states and part.joins_by_state(given, iteration))
    ]


def check_together(parts: Collection[Part], given: argparse.Namespace, several: bool) -> None:
    """Refuse a part that does not work with other options, or with several processes (UserError)."""
    for part in parts:
        asked = part.asked_by(given)
        option = asked or f"--{part.name}"
        if several and not part.needs.ranks:
            remedy = "leave it out, or start" if asked else f"it is in {given.start_checkpoint}, so start"
            raise UserError(f"{option} needs a training of one process; {remedy} train.py without torchrun")
        for other, reason in part.against.items():
            name, _, value = other.partition("=")
            there = getattr(given, name, None)
            if str(there) == value if value else there:
                raise UserError(f"{option} does not work with --{name}{value and ' '}{value}, {reason}")
