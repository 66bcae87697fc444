"""Photos as cameras make them, and appearance.json.

A colour c of a render, channel by channel, r half diagonals of the image from the middle of the vignetting:

    x = c 2^(e + w + a r^2 + 3 b r^2 (r^2 - 1/2))
    y = x + s (1 - s) ((1 - s) p + s q),    s = min(max(x, 0), 1)

Of a photo: the exposure e and the balance w of the channels, whose sum is 0. Of a camera, which photos share: a and b
of each channel, the middle, and p and q of each channel's response. The steps and what they belong to are those of
PPISP (Deutsch et al. 2026, section 4); stops, bases and curve are our own:

- Gains are stops, so they add up (exposure and vignetting: Goldman 2010; gains for white: von Kries 1902).
- Light never gains towards the corners. The second term of the vignetting hardly resembles the first over an image, so
  that both are learnt at one rate.
- The response is a cubic with y(0) = 0 and y(1) = 1. Its Bernstein coefficients rise by the softmax of three numbers,
  so it rises, too (Farouki 2012). Beyond [0, 1] its slope is 1.
- All numbers are 0 in a camera that changes nothing, and the loss pulls them there.
- Exposures, balances and the three numbers of responses count from their mean over all training photos. What photos
  have in common belongs to the Gaussians, or these would take on a cast, or another contrast, that nothing holds.

appearance.json has the three numbers of each of the `photos` by name, and those of `cameras` by their number, with the
names of _PHOTO and _CAMERA.
"""

import argparse
import math
import os
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from groundwork.deterministic.portable_math import exponential, square_root
from groundwork.files.json_files import read_json, write_json
from groundwork.host.machine import compute_device
from scene.gaussians.adam import GaussianAdam
from scene.gaussians.exposure import Exposures
from scene.gaussians.table import trainable
from scene.readers.info import CameraInfo, photo_names
from utils.general_utils import get_expon_lr_func
from utils.system_utils import UserError

NAME = "appearance.json"
_REMEDY = "save the model again, or give --appearance none"
UNTRAINED = ""  # the name of photos that are held out
_SHARED = "all"  # the camera of scenes in which each photo has a number of its own, as frames of Blender have
# Of the numbers of a photo or a camera: shape, learning rate at the start, and weight of their squares in the loss.
_PHOTO = {"photos": ((3,), 0.03, 0.02)}  # exposure, red against blue, and both against green; stops
_CAMERA = {
    "vignetting": ((3, 2), 0.1, 0.001),  # a and b of red, green and blue; stops
    "middle": ((2,), 0.001, 0.01),  # from that of the image, right and down; half diagonals
    "response": ((3, 3), 0.002, 0.001),  # logarithms of rises, of red, green and blue
}
_ALL = _PHOTO | _CAMERA
_SMALL = 0.01  # numbers are pulled by their sizes beyond this: less is noise, which squares would hardly hold
_DELAY = 0.1  # part of the training over which they rise, as the first renders are dark
_FALL = 0.01  # of the learning rates, from the first to the last step
_FITS = 20  # Gauss-Newton steps
_FARTHEST = 5.0  # stops
_LN2 = math.log(2)


class PhotoAppearance(Exposures):
    """The numbers of training photos and of their cameras, in the place of `Exposures`.

    values: numbers of the photos, (n, 3).
    numbers: all tensors, by name.
    mapping: index by the photo's name.
    held: true while nothing is learnt, as after a reset of the opacities, when all renders are dark.
    """

    kind: ClassVar[str] = "ppisp"
    applied = True

    def __init__(self, names: Sequence[str] = (), cameras: Sequence[object] = ()) -> None:
        """Name the photos and their cameras.

        cameras: the number of each photo's camera.
        """
        ids = [str(camera) for camera in cameras]
        self.cameras = [_SHARED] * len(ids) if len(set(ids)) == len(ids) else ids  # of each photo
        super().__init__(names)

    def start(self, names: Sequence[str]) -> None:
        """Begin with photos and cameras that change nothing."""
        self.mapping = {name: index for index, name in enumerate(names)}
        self.rows = {camera: row for row, camera in enumerate(dict.fromkeys(self.cameras))}
        device = compute_device()
        self._row_of = torch.tensor([self.rows[camera] for camera in self.cameras], dtype=torch.int64, device=device)
        self._indices = torch.arange(len(names), device=device).split(1)
        self.numbers = {name: torch.zeros(self._count(name), *_ALL[name][0], device=device) for name in _ALL}

    def _count(self, name: str) -> int:
        return len(self.mapping if name in _PHOTO else self.rows)

    @property
    def values(self) -> Tensor:
        """The numbers of the photos."""
        return self.numbers["photos"]

    def index(self, name: str | Tensor) -> Tensor:
        """Return the index (1,) int64 of a photo, on the device. A recorded step gives the index, not a name."""
        if isinstance(name, Tensor):
            return name
        if name not in self.mapping:
            raise UserError(f"there is no trained appearance of {name}; render photos that the model was trained on")
        return self._indices[self.mapping[name]]

    def camera_of(self, colmap_id: object) -> Tensor | None:
        """Return the row (1,) of a view's camera; None if no photo of that camera has trained."""
        row = self.rows.get(_SHARED, self.rows.get(str(colmap_id)))
        return None if row is None else self._indices[row]

    def photo(self, name: str | Tensor) -> Tensor:
        """Return a photo's exposure, red against blue, and both against green: (3,), stops from the mean of photos."""
        photos = self._read("photos")
        return _select_row(photos, self.index(name)) - photos.detach().mean(0)

    def _response(self, row: Tensor) -> Tensor:
        """Return the logarithms of the rises of a camera's response (3, 3), from their mean over all photos."""
        responses = self._read("response")
        return _select_row(responses, row) - responses.detach()[self._row_of].mean(0)

    def covers(self, name: str | None) -> bool:
        return name in self.mapping

    def shown(self, image: Tensor, name: str | Tensor) -> Tensor:
        """Return a render as the photo of this name shows it. Differentiable in the image, too.

        image: (3, H, W), not clamped.
        """
        return self._show(image, _to_gains(self.photo(name)), self._row_of.index_select(0, self.index(name)))

    def size_penalty(self, name: str | Tensor) -> Tensor:
        """Return the loss term of a photo: sizes of the photo's numbers and its camera's, weighted and smoothed."""
        row = self._row_of.index_select(0, self.index(name))
        found = {"photos": self.photo(name), "response": self._response(row)}
        found |= {kind: _select_row(self._read(kind), row) for kind in ("vignetting", "middle")}
        return sum(_ALL[kind][2] * square_root(numbers.square() + _SMALL**2).sum() for kind, numbers in found.items())

    @torch.no_grad()
    def fitted(self, image: Tensor, target: Tensor, counts: Tensor, colmap_id: object) -> Tensor:
        """Return a render (3, H, W) in [0, 1] as a photo shows it that has not trained.

        The gains of the photo, one for each channel, are those of the least squared difference to the photo where
        pixels count.

        image, target: (3, H, W), the render and the photo.
        counts: (1, H, W) bool.
        """
        row, gains = self.camera_of(colmap_id), image.new_zeros(3, 1, 1)
        for _ in range(_FITS):
            with torch.enable_grad():
                each = gains.expand_as(image).requires_grad_()
                shown = self._show(image, each, row).clamp(0, 1)
                (slope,) = torch.autograd.grad(shown.sum(), each)
            slope = torch.where(counts, slope, 0.0).double()
            change = (slope * (target - shown)).sum((1, 2), True) / slope.square().sum((1, 2), True).clamp_min(1e-12)
            gains = (gains + change.clamp(-1, 1).float()).clamp(-_FARTHEST, _FARTHEST)
        return self._show(image, gains, row).clamp(0, 1)

    def _show(self, image: Tensor, gains: Tensor, row: Tensor | None) -> Tensor:
        """Return a render as a camera shows it.

        gains: (3, 1, 1), of the channels, in stops.
        row: row of the camera; None: a camera that changes nothing.
        """
        gains = _LN2 * gains  # the last bit of torch.exp2 depends on the number of threads
        if row is None:
            return image * exponential(gains)
        right, down = _pixel_places(*image.shape[-2:], image.device)
        middle, falloff = (_select_row(self._read(kind), row) for kind in ("middle", "vignetting"))
        a, b = (_LN2 * falloff[..., None, None]).unbind(1)
        square = (right - middle[:1]).square()[None, :] + (down - middle[1:]).square()[:, None]
        x = image * exponential(gains + square * (a + (3 * square - 1.5) * b))
        rises = torch.softmax(self._response(row), 1)
        p, q = 3 * (rises[:, 0] - 1 / 3)[:, None, None], 3 * (1 / 3 - rises[:, 2])[:, None, None]
        s = x.clamp(0, 1)
        return x + s * (1 - s) * (p + s * (q - p))

    def _read(self, name: str) -> Tensor:
        values = self.numbers[name]
        return values.detach() + 0 * values if self.held else values  # steps are counted in any case

    # Training, checkpoints and the file

    def training_setup(self, opt: argparse.Namespace) -> None:
        """Make the numbers trainable, with an optimiser and the schedule of its rates.

        opt: options, of which `iterations` is the length of the schedule.
        """
        self.numbers = {name: trainable(values) for name, values in self.numbers.items()}
        groups = [{"params": [values], "lr": _ALL[name][1], "name": name} for name, values in self.numbers.items()]
        self.optimizer = GaussianAdam(groups)
        self._gradients = [torch.zeros_like(values) for values in self.numbers.values()]
        steps = getattr(opt, "iterations", 30_000)
        self.schedule = get_expon_lr_func(1.0, _FALL, int(_DELAY * steps), 0.0, steps)

    def update_learning_rate(self, iteration: int) -> None:
        if self.optimizer is not None:
            for group in self.optimizer.param_groups:
                group["lr"] = 0.0 if self.held else _ALL[group["name"]][1] * self.schedule(iteration)

    @torch.no_grad()
    def step(self) -> None:
        """Take a step if there is a gradient, and keep the vignetting one that brightens no place."""
        super().step()
        a, b = self.numbers["vignetting"].unbind(2)
        a.clamp_(max=0)  # once more changes no bit, as in a step that is repeated
        b.copy_(torch.minimum(torch.maximum(b, a / 1.5), -a / 4.5))

    def rows_named(self, name: str) -> list[str]:
        return self.names if name in _PHOTO else [f"camera {camera}" for camera in self.rows]

    def capture(self) -> dict[str, Any]:
        values = {name: values.detach() for name, values in self.numbers.items()}
        known = {"kind": self.kind, "names": self.names, "cameras": self.cameras}
        return {**known, "numbers": values, "optimizer": self.optimizer.state_dict()}

    def take_values(self, state: dict[str, Any]) -> None:
        """Take the numbers of a state that `capture` has returned. UserError if they are of other photos or cameras."""
        found = state.get("numbers")
        fits = isinstance(found, dict) and state.get("cameras") == self.cameras
        for name, values in self.numbers.items():
            given = found.get(name) if fits else None
            if not torch.is_tensor(given) or given.shape != values.shape or given.dtype != torch.float32:
                raise UserError(f"the checkpoint has no {name} of this run's appearance; use another checkpoint")
            with torch.no_grad():
                values.copy_(given)

    def check_finite(self, where: str, remedy: str) -> None:
        """Raise UserError with the first photo or camera that has a number which is not finite.

        where: name of the file that the numbers are in or for, for the message.
        remedy: advice that ends the message.
        """
        for name, values in self.numbers.items():
            finite = values.detach().isfinite().flatten(1).all(dim=1)
            if not finite.all():
                row = self.rows_named(name)[int((~finite).nonzero()[0])]
                raise UserError(f"the {name} of {row} in {where} is not finite; {remedy}")

    def write(self, folder: str | os.PathLike) -> None:
        """Write appearance.json: numbers of the photos by name, and of the cameras by their number in the scene."""
        photos = {name: self.photo(name).tolist() for name in self.mapping}
        cameras = {
            camera: {name: self.numbers[name][row].tolist() for name in _CAMERA}
            | {"response": self._response(self._indices[row]).tolist()}
            for camera, row in self.rows.items()
        }
        write_json(Path(folder) / NAME, {"photos": photos, "cameras": cameras})


def appearance_of(views: Sequence[CameraInfo]) -> PhotoAppearance:
    """Return an appearance of training photos that changes nothing."""
    return PhotoAppearance(photo_names(views), [view.uid for view in views])


def read_appearance(folder: str | os.PathLike, views: Sequence[CameraInfo]) -> PhotoAppearance:
    """Read the appearance of photos and their cameras from a model folder. UserError for a file of other photos."""
    path, appearance = Path(folder) / NAME, appearance_of(views)
    try:
        table = read_json(path)
        photos, of_cameras = dict(table["photos"]), dict(table["cameras"])
        rows = {"photos": [photos[name] for name in appearance.mapping]}
        rows |= {kind: [of_cameras[camera][kind] for camera in appearance.rows] for kind in _CAMERA}
        found = {kind: torch.tensor(values, dtype=torch.float32) for kind, values in rows.items()}
    except OSError as error:
        raise UserError(f"cannot read {path} ({error.strerror}); {_REMEDY}") from error
    except KeyError as error:
        raise UserError(f"{path} has no entry for {error.args[0]}, so it belongs to other photos; {_REMEDY}") from error
    except (TypeError, ValueError, RuntimeError, OverflowError, RecursionError) as error:
        raise UserError(f"{path} is no table of appearances; {_REMEDY}") from error
    for kind, values in appearance.numbers.items():
        if found[kind].shape != values.shape or not found[kind].isfinite().all():
            raise UserError(f"{kind} in {path} are not {_ALL[kind][0]} finite numbers each; {_REMEDY}")
        values.copy_(found[kind])
    return appearance


def _select_row(values: Tensor, index: Tensor) -> Tensor:
    return values.index_select(0, index)[0]


def _to_gains(photo: Tensor) -> Tensor:
    """Return the stops (3, 1, 1) of red, green and blue by the numbers of a photo."""
    exposure, red, others = photo.unbind()
    return torch.stack([exposure + red + others, exposure - 2 * others, exposure - red + others])[:, None, None]


@cache
def _pixel_places(height: int, width: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the places of columns and rows from the middle of an image, in half diagonals."""
    half = 0.5 * (height**2 + width**2) ** 0.5
    with torch.inference_mode(False):  # so that training can use them after a render in inference mode
        return tuple((torch.arange(side, device=device) + 0.5 - side / 2) / half for side in (width, height))
