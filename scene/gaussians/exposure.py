"""Colour maps of the training photos, trained with the Gaussians (--appearance affine), and exposure.json."""

import argparse
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from groundwork.files.plain_files import plain_text
from groundwork.host.machine import compute_device
from scene.gaussians.adam import GaussianAdam
from scene.gaussians.table import trainable
from utils.general_utils import get_expon_lr_func
from utils.system_utils import UserError, atomic_write

NAME = "exposure.json"
_REMEDY = "restore the file, or leave --appearance affine out and write train_test_exp=False into cfg_args"
# torch's defaults, which the reference uses for exposures; update_learning_rate replaces the rate.
_ADAM_EPS, _ADAM_RATE = 1e-8, 1e-3


class Exposures:
    """Affine maps of colours, one per training photo: `values` (n, 3, 4) float32, [I | 0] at first.

    A pixel c, a row vector, becomes c A[:, :3] + A[:, 3] (`apply_exposure`). A part may use a subclass instead.

    mapping: index by the photo's name.
    pretrained: None, or maps (3, 4) by name that are used in place of the values.
    optimizer: the values' optimiser, None before training_setup.
    schedule: the learning rate by iteration.
    kind: value of --appearance.
    applied: whether a training applies exposures to renders before it compares them with photos.
    held: whether strategies have darkened renders, so that a subclass should not learn; this class learns in any case,
    as the reference does.
    shown: takes the place of `apply_exposure`: maps a render (3, H, W), not clamped, and a photo's name to an image.
    """

    kind: ClassVar[str] = "affine"
    shown: ClassVar[Callable[..., Tensor] | None] = None
    applied = False
    held = False

    def __init__(self, names: Sequence[str] = ()) -> None:
        self.start(names)
        self.pretrained: dict[str, Tensor] | None = None
        self.optimizer: torch.optim.Optimizer | None = None
        self.schedule: Callable[[int], float] | None = None

    def start(self, names: Sequence[str]) -> None:
        """Give each of these photos a map that changes nothing."""
        self.mapping = {name: index for index, name in enumerate(names)}
        self.values: Tensor = nn.Parameter(torch.eye(3, 4, device=compute_device()).repeat(len(names), 1, 1))

    def __getitem__(self, name: str | Tensor) -> Tensor:
        """Map (3, 4) of a photo, differentiable. UserError for a photo that was not trained on.

        A recorded step has its index (1,) int64, on the device, in the place of a name.
        """
        if isinstance(name, Tensor):
            return self.values.index_select(0, name)[0]
        if self.pretrained is not None and name in self.pretrained:
            return self.pretrained[name]
        if self.pretrained is not None or name not in self.mapping:
            raise UserError(f"there is no trained exposure of {name}; render photos that the model was trained on")
        return self.values[self.mapping[name]]

    @property
    def names(self) -> list[str]:
        """Names of the photos, in the order of the values."""
        return sorted(self.mapping, key=self.mapping.__getitem__)

    def covers(self, name: str | None) -> bool:
        """Tell whether every render of that photo's view applies the exposure, without an option that asks for it."""
        return False

    @property
    def trained(self) -> bool:
        """True if the exposures took a step of training, in this run or in the one it resumes."""
        return self.optimizer is not None and bool(self.optimizer.state)

    def training_setup(self, opt: argparse.Namespace) -> None:
        """Make the optimiser and the schedule from the optimisation options, or their defaults where `opt` lacks them.

        The 2023 release has no such options.
        """
        self.values = trainable(self.values)
        self.optimizer = GaussianAdam([{"params": [self.values], "lr": _ADAM_RATE, "name": "exposure"}], eps=_ADAM_EPS)
        self._gradients = [torch.zeros_like(self.values)]
        self.schedule = get_expon_lr_func(
            getattr(opt, "exposure_lr_init", 0.01),
            getattr(opt, "exposure_lr_final", 0.001),
            getattr(opt, "exposure_lr_delay_steps", 0),
            getattr(opt, "exposure_lr_delay_mult", 0.0),
            getattr(opt, "iterations", 30_000),
        )

    def update_learning_rate(self, iteration: int) -> None:
        """Set the learning rate of this iteration, if there is an optimiser and a schedule."""
        if self.optimizer is not None and self.schedule is not None and self.pretrained is None:
            self.optimizer.param_groups[0]["lr"] = self.schedule(iteration)

    def keep_gradients(self) -> None:
        """Keep gradients at fixed addresses, where a recorded step writes them and `step` reads them."""
        for group, gradient in zip(self.optimizer.param_groups, self._gradients, strict=True):
            group["params"][0].grad = gradient

    def step(self) -> None:
        """Step if there is a gradient, and drop the gradient."""
        if self.optimizer is not None and self.values.grad is not None:
            self.optimizer.step()
            self.optimizer.zero_grad(set_to_none=True)

    def capture(self) -> dict[str, Any]:
        """State that a resumed training needs, as plain values."""
        return {"names": self.names, "values": self.values.detach(), "optimizer": self.optimizer.state_dict()}

    def restore(self, state: dict[str, Any]) -> None:
        """Take the state of `capture()`, after training_setup. UserError for a state that does not fit."""
        if state.get("names") != self.names:
            raise UserError(
                "the checkpoint's exposures are of other photos than this run's, which cannot be added; give the scene "
                "and the options --eval and --appearance that it was trained with"
            )
        self.take_values(state)
        self.check_finite("the checkpoint", "use another checkpoint")
        try:
            self.optimizer.take_state(state.get("optimizer"))
        except ValueError as error:
            raise UserError(f"the exposures' optimiser state in the checkpoint does not fit ({error})") from error

    def take_values(self, state: dict[str, Any]) -> None:
        """Take the values of a state of the same photos."""
        values = state.get("values")
        if not torch.is_tensor(values) or values.shape != self.values.shape or values.dtype != torch.float32:
            raise UserError(
                f"the checkpoint's exposures are not {tuple(self.values.shape)} float32; use another checkpoint"
            )
        with torch.no_grad():
            self.values.copy_(values)

    def check_finite(self, where: str, remedy: str) -> None:
        """UserError naming the first photo whose map is not finite."""
        finite = self.values.detach().isfinite().flatten(1).all(dim=1)
        if not finite.all():
            name = self.names[int((~finite).nonzero()[0])]
            raise UserError(f"the exposure of {name} in {where} is not finite; {remedy}")

    def write(self, folder: str | os.PathLike) -> None:
        """Write exposure.json: the three rows of each map, by name."""
        table = {name: self[name].detach().tolist() for name in self.mapping}
        with atomic_write(Path(folder) / NAME) as path:
            path.write_text(json.dumps(table, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def read_exposures(folder: str | os.PathLike, names: Sequence[str], image_names: Sequence[str]) -> Exposures:
    """Exposures of the photos `names` from a model folder's exposure.json. UserError if one is missing or broken.

    image_names: the same photos' names in the reference's files, which several photos may share.
    """
    path = Path(folder) / NAME
    table = _read_table(path)
    exposures = Exposures(names)
    for index, (name, image_name) in enumerate(zip(names, image_names, strict=True)):
        rows = table.get(name, table.get(image_name))
        if rows is None:
            raise UserError(f"{path} has no exposure of {name}; {_REMEDY}")
        with torch.no_grad():
            exposures.values[index] = _read_map(rows, name, path)
    return exposures


def read_pretrained(folder: str | os.PathLike) -> dict[str, Tensor] | None:
    """All maps (3, 4) of a model folder's exposure.json, by name; None, and a line that says so, without that file."""
    path = Path(folder) / NAME
    if not path.exists():
        print(f"no exposures are loaded: there is no {path}")
        return None
    return {name: _read_map(rows, name, path).to(compute_device()) for name, rows in _read_table(path).items()}


def _read_table(path: Path) -> dict[str, Any]:
    """The table of an exposure.json; UserError for a file that has none."""
    try:
        table = json.loads(plain_text(path))
    except OSError as error:
        raise UserError(f"cannot read {path} ({error.strerror}); {_REMEDY}") from error
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is not JSON; {_REMEDY}") from error
    if not isinstance(table, dict):
        raise UserError(f"{path} is not a table of exposures by photo; {_REMEDY}")
    return table


def _read_map(rows: Any, name: str, path: Path) -> Tensor:
    """One map (3, 4) of the table, checked."""
    try:
        value = torch.tensor(rows, dtype=torch.float32)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise UserError(f"the exposure of {name} in {path} is not a matrix of numbers; {_REMEDY}") from error
    if value.shape != (3, 4) or not value.isfinite().all():
        raise UserError(f"the exposure of {name} in {path} is not 3 x 4 finite numbers; {_REMEDY}")
    return value


def apply_exposure(image: Tensor, exposure: Tensor) -> Tensor:
    """Map the colours c, row vectors, of an image (3, H, W) to c A + b. The exposure (3, 4) is [A | b].

    Differentiable in both. Uses products and sums of whole planes, because the rounding of a matrix product and of its
    gradient may depend on the number of threads.
    """
    red, green, blue = (image[i] * exposure[i, :3, None, None] for i in range(3))
    return red + green + blue + exposure[:, 3, None, None]
