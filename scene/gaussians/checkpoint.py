"""Checkpoints, files chkpntN.pth of (state of the model, N): tensors and plain values."""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from numbers import Real
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from groundwork.files.tensor_files import read_tensors
from groundwork.host.machine import VERSION
from scene.gaussians.adam import GaussianAdam
from scene.gaussians.attributes import IN_CHECKPOINT, Attribute, Rows
from scene.gaussians.exposure import Exposures
from scene.gaussians.finite import check_finite, with_scales
from scene.gaussians.parameters import GaussianParameters
from scene.gaussians.statistics import NAMES, Statistics
from utils.system_utils import UserError, atomic_write, writes_files

_LARGEST = 1e15  # extent; learning rates are multiples of it
_OPTIMIZER = 10  # which entry its state dict is
_ENTRIES = 12  # the reference's; the values of further attributes may follow
EXPOSURES, WRITTEN_BY = "exposures", "version"  # keys in the optimiser's state dict
_NO_EXTRA = {WRITTEN_BY, EXPOSURES, "state", "param_groups"}


class State(NamedTuple):
    """Everything of a model that a resumed training needs."""

    active_sh_degree: int
    rows: Rows
    statistics: Statistics
    optimizer: dict[str, Any]  # its state dict
    spatial_lr_scale: float
    exposures: dict[str, Any] | None  # None: not trained

    def map_rows(self, change: Callable[[Tensor], Tensor]) -> "State":
        """Return the state with `change` applied to each tensor that has a row for each Gaussian.

        These are the values, the statistics and Adam's averages; `change` may return another number of rows.
        """
        count = len(self.statistics.denom)

        def changed(values: Any) -> Any:
            if not torch.is_tensor(values) or not values.dim() or len(values) != count:
                return values
            new = change(values)
            return nn.Parameter(new) if isinstance(values, nn.Parameter) and new is not values else new

        optimizer = self.optimizer
        states = optimizer.get("state") if isinstance(optimizer, dict) else None
        if isinstance(states, dict) and all(isinstance(state, dict) for state in states.values()):
            averages = {key: {name: changed(v) for name, v in state.items()} for key, state in states.items()}
            optimizer = optimizer | {"state": averages}  # GaussianAdam.take_state refuses any other
        return self._replace(
            rows={name: changed(values) for name, values in self.rows.items()},
            statistics=replace(self.statistics, **{n: changed(getattr(self.statistics, n)) for n in NAMES}),
            optimizer=optimizer,
        )


def capture(gaussians: GaussianParameters) -> tuple:
    """Collect everything that a resumed training needs, as tensors and numbers; `pack` gives the order.

    Values of Gaussians are parameters: the reference trains on with the very tensors that a checkpoint holds. Of
    several processes, all of which must call it, the first has the whole state, on the CPU, and others have no rows.
    """
    raw = {name: getattr(gaussians, a.field) for name, a in gaussians._attributes.items()}
    gaussians.shards.match_steps(gaussians.optimizer)
    state = State(
        gaussians.active_sh_degree,
        {name: x if isinstance(x, nn.Parameter) else nn.Parameter(x.detach()) for name, x in raw.items()},
        gaussians.statistics,
        gaussians.optimizer.state_dict(),
        float(gaussians.spatial_lr_scale),
        gaussians.exposures.capture() if gaussians.exposures.trained else None,
    )
    return pack(state.map_rows(gaussians.shards.gather_whole))


def restore(gaussians: GaussianParameters, model_args: Sequence[Any], training_args: argparse.Namespace) -> None:
    """Take the state of `capture()`. Learning rates and densification options come from `training_args`.

    A model without exposures takes those of the state, too; one that has them must have the same photos.
    UserError when the state was made with another maximal SH degree or does not fit together.
    """
    state = unpack(model_args, gaussians._attributes, gaussians.max_sh_degree).map_rows(gaussians.shards.own_rows)
    gaussians.active_sh_degree = state.active_sh_degree
    gaussians.spatial_lr_scale = state.spatial_lr_scale
    gaussians.set_rows(state.rows)
    exposures = state.exposures
    if exposures is not None and exposures.get("kind", Exposures.kind) != gaussians.exposures.kind:
        exposures = None  # a part takes them
    elif exposures is not None and not gaussians.exposures.mapping:  # a model without a scene
        names = exposures.get("names")
        if isinstance(names, list) and all(isinstance(name, str) for name in names):  # else `restore` refuses them
            gaussians.exposures = Exposures(names)
    gaussians.training_setup(training_args)
    try:
        if isinstance(gaussians.optimizer, GaussianAdam):
            lacking = gaussians.optimizer.take_state(state.optimizer)
        else:  # a subclass has set up another
            gaussians.optimizer.load_state_dict(state.optimizer)
            lacking = []
    except ValueError as error:
        raise UserError(f"the optimiser state of the checkpoint does not fit ({error}); use another one") from error
    if "xyz" in lacking:  # f_rest may lack it, as Gaussians without active bands have no steps
        names = ", ".join(map(str, lacking))
        print(f"warning: the checkpoint has no averages of Adam for {names}; they begin at zero", file=sys.stderr)
    if exposures is not None:
        gaussians.exposures.restore(exposures)
    gaussians.statistics = state.statistics.to(gaussians._xyz.device)


def pack(state: State) -> tuple:
    """The 12 entries of the reference, in its order.

    Attributes that the reference does not have follow as further entries. Exposures, if they are trained, and the
    version of this code stand in the optimiser's state dict: the reference takes exactly 12 entries, and torch's
    optimisers pass over keys that they do not know.
    """
    ours = {WRITTEN_BY: VERSION} if state.exposures is None else {WRITTEN_BY: VERSION, EXPOSURES: state.exposures}
    return (
        state.active_sh_degree,
        *(state.rows[name] for name in IN_CHECKPOINT),
        state.statistics.max_radii2D,
        state.statistics.xyz_gradient_accum,
        state.statistics.denom,
        state.optimizer | ours,
        state.spatial_lr_scale,
        *(values for name, values in state.rows.items() if name not in IN_CHECKPOINT),
    )


def with_extra_state(entries: tuple, states: dict[str, Any]) -> tuple:
    """Add extra state of a training to the optimiser's state dict, by key."""
    return (*entries[:_OPTIMIZER], entries[_OPTIMIZER] | states, *entries[_OPTIMIZER + 1 :])


def extra_state(entries: Sequence[Any]) -> dict[str, Any]:
    """The state that `with_extra_state` has added, and exposures; only exposures in a checkpoint of other code."""
    optimizer, found = entries[_OPTIMIZER], _find_exposures(entries)
    extra = {} if found is None else {EXPOSURES: found}
    if not isinstance(optimizer, dict) or WRITTEN_BY not in optimizer:
        return extra
    return {key: state for key, state in optimizer.items() if key not in _NO_EXTRA} | extra


def _find_exposures(entries: Sequence[Any]) -> dict[str, Any] | None:
    """The state of trained exposures; until 0.1.0, it was the last entry."""
    found = next((entry for entry in entries[_ENTRIES:] if isinstance(entry, dict)), None)
    optimizer = entries[_OPTIMIZER]
    found = optimizer.get(EXPOSURES, found) if isinstance(optimizer, dict) else found
    return found if isinstance(found, dict) and isinstance(found.get("kind", ""), str) else None


def unpack(entries: Sequence[Any], table: dict[str, Attribute], max_sh_degree: int) -> State:
    """The state from the entries that `pack` made. UserError if its attributes are not those of the table."""
    active_sh_degree, *tensors = entries[:7]
    max_radii2D, xyz_gradient_accum, denom, optimizer, spatial_lr_scale, *others = entries[7:]
    names = (*IN_CHECKPOINT, *(name for name in table if name not in IN_CHECKPOINT))
    tensors += [entry for entry in others if not isinstance(entry, dict)]
    if len(tensors) != len(names):
        raise UserError(
            f"the checkpoint has {len(tensors)} attributes per Gaussian, but this model has {len(names)} "
            f"({', '.join(names)}); give a checkpoint of this model"
        )
    rows = {name: tensor.detach() for name, tensor in zip(names, tensors, strict=True)}
    rows["scaling"] = with_scales(rows["scaling"])
    check_rows(rows, table, max_sh_degree)
    if not 0 <= active_sh_degree <= max_sh_degree:
        raise UserError(
            f"the active SH degree of the checkpoint is {active_sh_degree}, more than --sh_degree {max_sh_degree}; "
            "give the --sh_degree it was trained with"
        )
    statistics = Statistics(max_radii2D, xyz_gradient_accum, denom)
    return State(int(active_sh_degree), rows, statistics, optimizer, float(spatial_lr_scale), _find_exposures(entries))


def check_rows(rows: Rows, table: dict[str, Attribute], max_sh_degree: int) -> None:
    """UserError for rows that do not have the names and shapes of the table, or are not finite."""
    for name, values in rows.items():
        shape = table[name].shape
        found = tuple(values.shape[1:])
        if name == "f_rest" and found[1:] == shape[1:] and found != shape:
            degree = next((d for d in range(4) if (d + 1) ** 2 - 1 == found[0]), None)
            remedy = "a checkpoint of this model" if degree is None else f"--sh_degree {degree}, that of its training"
            raise UserError(
                f"the checkpoint does not have the SH coefficients of --sh_degree {max_sh_degree}; give {remedy}"
            )
        if found != shape or values.dtype != torch.float32:
            raise UserError(
                f"{name} of the checkpoint has the shape {found} and type {values.dtype} per Gaussian, not {shape} "
                "and float32; give a checkpoint of this model"
            )
    check_finite(rows, "the checkpoint", "give another one")


def save_checkpoint(path: str | os.PathLike, capture: tuple, iteration: int) -> None:
    """Write (capture, iteration), on the rank that writes; the whole file or none."""
    if not writes_files():
        return
    # To an open file, as torch would write a path's name into the archive, and the temporary one is never the same.
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        try:
            torch.save((capture, iteration), file)
        except RuntimeError as error:
            # torch hides the cause when its archive writer fails, but the content is never the cause.
            if "inline_container" not in str(error) and "PytorchStreamWriter" not in str(error):
                raise
            raise _find_write_error(temporary) from error


def _find_write_error(temporary: Path) -> OSError:
    """Find the reason why a file cannot be written, by writing more."""
    try:
        with open(temporary, "ab") as file:
            file.write(bytes(1 << 20))
    except OSError as error:
        return error
    return OSError("no space is left, or the file is larger than allowed")


def load_checkpoint(path: str | os.PathLike, mapped: bool = False) -> tuple[tuple, int]:
    """Read (capture, iteration), ours or the reference's, on the CPU. UserError for any other file.

    mapped: tensors stay in the file until somebody reads a part of them.
    """
    _refuse_other_kinds(path)
    try:
        content = read_tensors(path, mapped=mapped)
    except ValueError as error:
        raise UserError(f"{path} is not a checkpoint of train.py: {error}; give a chkpntN.pth") from error
    try:
        return _check_content(content)
    except ValueError as error:
        raise UserError(
            f"{path} is not a checkpoint of train.py: its parts do not fit together ({error}); give a chkpntN.pth"
        ) from error


def _check_content(content: Any) -> tuple[tuple, int]:
    """Capture and iteration. ValueError says what is wrong; `unpack` checks the shapes of the attributes."""
    if not isinstance(content, tuple | list) or len(content) != 2:
        raise ValueError("it is not a pair of a state and an iteration")
    capture, iteration = content
    if not isinstance(capture, tuple | list) or len(capture) < _ENTRIES:
        raise ValueError(f"the state has fewer than {_ENTRIES} entries")
    if type(iteration) is not int or not 0 <= iteration < 2**31:
        raise ValueError(f"the iteration is {_describe_value(iteration)}")
    if type(capture[0]) is not int or not 0 <= capture[0] <= 3:
        raise ValueError(f"the active SH degree is {_describe_value(capture[0])}")
    per_gaussian = (*capture[1:10], *(entry for entry in capture[_ENTRIES:] if not isinstance(entry, dict)))
    if not all(torch.is_tensor(t) and t.dim() > 0 and t.dtype == torch.float32 for t in per_gaussian):
        raise ValueError("a per-Gaussian value is not a float32 tensor")
    count = len(capture[1])
    if count == 0:
        raise ValueError("it has no Gaussians")
    if any(len(tensor) != count for tensor in per_gaussian):
        raise ValueError("tensors differ in the number of Gaussians")
    if [tuple(tensor.shape[1:]) for tensor in capture[7:10]] != [(), (1,), (1,)]:
        raise ValueError("the statistics of density control have wrong shapes")
    extent = capture[11]
    if not isinstance(extent, Real) or isinstance(extent, bool) or not 0 <= extent < _LARGEST:
        raise ValueError(f"the extent of the scene is {_describe_value(extent)}")
    return tuple(capture), iteration


def _describe_value(value: Any) -> str:
    """A number, or the type of anything else: what a stranger's file says is never printed."""
    return str(value)[:40] if type(value) in (int, float) else f"a {type(value).__name__}"


def _refuse_other_kinds(path: str | os.PathLike) -> None:
    """Raise UserError for other things given by mistake: a missing file, a model folder, a point cloud."""
    if os.path.isdir(path):
        raise UserError(f"--start_checkpoint {path} is a folder; give the file chkpntN.pth in it")
    if not os.path.isfile(path):
        others = sorted(file.name for file in Path(path).parent.glob("chkpnt*.pth"))
        remedy = (
            f"give one of {', '.join(others)}" if others else "train with --checkpoint_iterations to have one written"
        )
        raise UserError(f"no checkpoint {path}; {remedy}")
    with open(path, "rb") as file:
        if file.read(4) in (b"ply\n", b"ply\r"):
            raise UserError(
                f"--start_checkpoint {path} is a PLY, which has no optimiser state to resume from; give a chkpntN.pth"
            )
