"""The registry of the parts of a training (splatting/part.py is their manual): their one order."""

import argparse
from collections.abc import Callable, Collection, Iterable, Mapping
from functools import cache
from importlib import import_module
from typing import Any

from groundwork.host.errors import UserError
from splatting.part import Appearance, Part, Strategy

# Names of modules, with the reason for the place, where there is one.
PARTS = (
    "time_budget",
    "exposure",  # adds training views before anything moves them
    "refine_poses",  # its cameras stand right before anything asks where they are
    "depths",
    "curve",  # its scores are those of the model that is saved in the same iteration
    "robust_mask",
    "adc",  # the first strategy is the default
    "mcmc",  # before budget: where a time is given, the first that is best in it is taken
    "budget",
    "sky",
    "sparse_depth",  # the order of the terms of the loss is in the bytes of the model
    "ppisp",
    "spill",  # after all that moves rows, and before sleep, which pays where rows lie on the host
    "sleep",  # after all that decides whether every step concerns all rows
    "tensorboard",  # from here on, those that only watch
    "resume",  # before all that may let the training wait
    "remote_viewer",
    "viewer",  # last: its pause is of all else
)


@cache
def part_class(name: str) -> type[Part]:
    """The class of the module `name`: its name in capital words."""
    return getattr(import_module(f"splatting.features.{name}"), "".join(map(str.capitalize, name.split("_"))))


def strategies() -> list[str]:
    """Names of the strategies of density control."""
    return [name for name in PARTS if issubclass(part_class(name), Strategy)]


def strategy_part(name: str) -> Strategy:
    """The part of a strategy. UserError for a name that is none of one: a file of another run may say anything."""
    if name not in strategies():
        raise UserError(f"there is no strategy {name!r}; give --strategy {' or '.join(strategies())}")
    return part_class(name)()


def in_order(parts: Iterable[Part]) -> list[Part]:
    """The parts in the order of the registry."""
    return sorted(parts, key=lambda part: PARTS.index(part.name))


def appearances() -> list[type[Appearance]]:
    """The parts that train how photos show renders (--appearance)."""
    return [kind for kind in map(part_class, PARTS) if issubclass(kind, Appearance)]


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
    """The states of parts by their names, from the extra state of a checkpoint. UserError for one of no part."""
    kinds = {kind.kind: kind.name for kind in appearances()}
    renamed = _OLD_KEYS | {EXPOSURES: kinds.get(checkpoint.get(EXPOSURES, {}).get("kind", "affine"), EXPOSURES)}
    named = {renamed.get(key, key): state for key, state in checkpoint.items()}
    if unknown := sorted(map(str, named.keys() - {*PARTS})):
        raise UserError(
            f"the checkpoint has a state of {unknown[0]}, which this code does not have; use the code that wrote it, "
            "or start a new training from its PLY by --init_ply"
        )
    return {name: state for name, state in named.items() if state is not None}


def chosen(given: argparse.Namespace, states: Collection[str] = ()) -> list[Part]:
    """The parts that options ask for, and those that a checkpoint brings by their state, in their order.

    given: options of all groups. states: names of parts that a checkpoint has states of.
    """
    kinds = map(part_class, PARTS)
    return [kind() for kind in kinds if kind.wanted(given) or (kind.by_state and kind.name in states)]


def check_together(parts: Collection[Part], given: argparse.Namespace, several: bool) -> None:
    """Refuse a part that does not work with other options, or with several processes (UserError)."""
    for part in parts:
        option = part.asked_by(given)
        if several and not part.needs.ranks:
            remedy = "leave it out, or start train.py without torchrun"
            if not part.wanted(given):
                remedy = f"it is in {given.start_checkpoint}, so start train.py without torchrun"
            raise UserError(f"{option} needs a training of one process; {remedy}")
        for other, reason in part.against.items():
            name, _, value = other.partition("=")
            there = getattr(given, name, None)
            if str(there) == value if value else there:
                raise UserError(f"{option} does not work with --{name}{value and ' '}{value}, {reason}")


def tools(name: str) -> list[Callable]:
    """The functions of a name that modules of parts have for others, which thus need no part.

    advise(scene, tracks): findings on a scene, and options of train.py that they speak for.
    backdrop(facts, means): which Gaussians of a model are not of the scene itself. facts: of model.json.
    advise_trained(scene, views): as advise, by a short training. examine(scene, views): notes of doctor.py.
    for_wrong_poses(best), for_few_iterations(count): remedies.
    pictures(model): files in a model folder that reports show, where they are there.
    prepare(dataset, opt, launch): may name the checkpoint to start with; False: nothing is left to train.
    """
    modules = [import_module(f"splatting.features.{part}") for part in PARTS]
    return [getattr(module, name) for module in modules if hasattr(module, name)]
