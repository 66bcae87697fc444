"""Colour corrections of the training photos, trained with the Gaussians (--train_test_exp), and exposure.json."""

import argparse
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from scene.gaussians.adam import GaussianAdam
from utils.general_utils import get_expon_lr_func
from utils.host.device import compute_device
from utils.system_utils import UserError, atomic_write

NAME = "exposure.json"
_ADAM_EPS = 1e-8  # torch's default, which the reference uses for exposures


class Exposures:
    """Affine maps of colours, one per training photo: `values` (n, 3, 4) float32, [I | 0] at first.

    A pixel c, a row vector, becomes c A[:, :3] + A[:, 3] (`apply_exposure`). names: of the photos, in order.
    """

    def __init__(self, names: Sequence[str] = ()) -> None:
        self.names = list(names)
        self._index = {name: index for index, name in enumerate(self.names)}
        self.values = nn.Parameter(torch.eye(3, 4, device=compute_device()).repeat(len(self.names), 1, 1))
        self.optimizer: GaussianAdam | None = None

    def __getitem__(self, name: str) -> Tensor:
        """Map (3, 4) of a photo, differentiable. UserError for a photo that was not trained on."""
        if name not in self._index:
            raise UserError(f"there is no trained exposure of {name}; render photos that the model was trained on")
        return self.values[self._index[name]]

    @property
    def trained(self) -> bool:
        """Whether they took a step of training, in this run or in the one it resumes."""
        return self.optimizer is not None and bool(self.optimizer.state)

    def training_setup(self, opt: argparse.Namespace) -> None:
        """Make the optimiser and the schedule from the optimisation options."""
        self.optimizer = GaussianAdam([{"params": [self.values], "lr": 0.0, "name": "exposure"}], eps=_ADAM_EPS)
        self._rate = get_expon_lr_func(
            opt.exposure_lr_init,
            opt.exposure_lr_final,
            opt.exposure_lr_delay_steps,
            opt.exposure_lr_delay_mult,
            opt.iterations,
        )

    def update_learning_rate(self, iteration: int) -> None:
        """Set the learning rate of this iteration."""
        self.optimizer.param_groups[0]["lr"] = self._rate(iteration)

    def step(self) -> None:
        """Step if there is a gradient, and drop the gradient."""
        if self.values.grad is not None:
            self.optimizer.step()
            self.optimizer.zero_grad(set_to_none=True)

    def capture(self) -> dict[str, Any]:
        """State that a resumed training needs, as plain values."""
        return {"names": self.names, "values": self.values.detach(), "optimizer": self.optimizer.state_dict()}

    def restore(self, state: dict[str, Any]) -> None:
        """Take the state of `capture()`, after training_setup. UserError for a state that does not fit."""
        if state.get("names") != self.names:
            raise UserError(
                "the checkpoint's exposures are of other photos than this run's; give the scene and the options "
                "--eval and --train_test_exp that it was trained with"
            )
        values = state.get("values")
        if not torch.is_tensor(values) or values.shape != self.values.shape or values.dtype != torch.float32:
            raise UserError(
                f"the checkpoint's exposures are not {tuple(self.values.shape)} float32; use another checkpoint"
            )
        with torch.no_grad():
            self.values.copy_(values)
        self.check_finite("the checkpoint", "use another checkpoint")
        try:
            self.optimizer.take_state(state.get("optimizer"))
        except ValueError as error:
            raise UserError(f"the exposures' optimiser state in the checkpoint does not fit ({error})") from error

    def check_finite(self, where: str, remedy: str) -> None:
        """UserError naming the first photo whose map is not finite."""
        finite = self.values.detach().isfinite().flatten(1).all(dim=1)
        if not finite.all():
            name = self.names[int((~finite).nonzero()[0])]
            raise UserError(f"the exposure of {name} in {where} is not finite; {remedy}")

    def write(self, folder: str | os.PathLike) -> None:
        """Write exposure.json: the three rows of each map, by name."""
        table = dict(zip(self.names, self.values.detach().tolist(), strict=True))
        with atomic_write(Path(folder) / NAME) as path:
            path.write_text(json.dumps(table, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def read_exposures(folder: str | os.PathLike, names: Sequence[str], image_names: Sequence[str]) -> Exposures:
    """Exposures of the photos `names` from a model folder's exposure.json. UserError if one is missing or broken.

    image_names: the same photos' names in the reference's files, which several photos may share.
    """
    path = Path(folder) / NAME
    remedy = "restore the file, or write train_test_exp=False into cfg_args to render without exposures"
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"cannot read {path} ({error.strerror}); {remedy}") from error
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is not JSON; {remedy}") from error
    if not isinstance(table, dict):
        raise UserError(f"{path} is not a table of exposures by photo; {remedy}")
    exposures = Exposures(names)
    for index, (name, image_name) in enumerate(zip(names, image_names, strict=True)):
        rows = table.get(name, table.get(image_name))
        if rows is None:
            raise UserError(f"{path} has no exposure of {name}; {remedy}")
        try:
            value = torch.tensor(rows, dtype=torch.float32)
        except (TypeError, ValueError, RuntimeError, OverflowError) as error:
            raise UserError(f"the exposure of {name} in {path} is not a matrix of numbers; {remedy}") from error
        if value.shape != (3, 4) or not value.isfinite().all():
            raise UserError(f"the exposure of {name} in {path} is not 3 x 4 finite numbers; {remedy}")
        with torch.no_grad():
            exposures.values[index] = value
    return exposures


def apply_exposure(image: Tensor, exposure: Tensor) -> Tensor:
    """Map the colours c, row vectors, of an image (3, H, W) to c A + b. The exposure (3, 4) is [A | b].

    Differentiable in both. Uses products and sums of whole planes, because the rounding of a matrix product and of its
    gradient may depend on the number of threads.
    """
    red, green, blue = (image[i] * exposure[i, :3, None, None] for i in range(3))
    return red + green + blue + exposure[:, 3, None, None]
