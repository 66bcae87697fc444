"""Formulas on small tensors, the learning-rate schedule, and the state of a run (seeds, stamped output)."""

import random
import sys
import time
from collections.abc import Callable
from typing import TextIO

import numpy as np
import torch
from PIL import Image
from torch import Tensor


def check_flags(**flags: object) -> None:
    """TypeError naming the first value that is not True, False, 1, 0, None, or a tensor."""
    for name, value in flags.items():
        if not torch.is_tensor(value) and value not in (None, False, True):
            raise TypeError(f"{name} must be True or False, got {value!r:.80}")


def inverse_sigmoid(x: Tensor) -> Tensor:
    """Logit of x in (0, 1), any shape: log(x / (1 - x))."""
    return torch.log(x / (1 - x))


def PILtoTorch(pil_image: Image.Image, resolution: tuple[int, int]) -> Tensor:
    """Picture as (C,H,W) float32 in [0,1], (1,H,W) if it is grey, after Pillow's resize to (width, height)."""
    pixels = torch.from_numpy(np.array(pil_image.resize(resolution))) / 255.0
    return pixels[None] if pixels.dim() == 2 else pixels.permute(2, 0, 1)


def build_rotation(r: Tensor) -> Tensor:
    """Rotation matrices (N,3,3) of quaternions r (N,4), order w x y z, any length; zero gives the identity."""
    w, x, y, z = torch.nn.functional.normalize(r, dim=-1).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def build_scaling_rotation(s: Tensor, r: Tensor) -> Tensor:
    """R diag(s) (N,3,3), the factor of the 3D covariance, of activated scales s (N,3) and quaternions r (N,4)."""
    return build_rotation(r) * s[:, None, :]


def strip_lowerdiag(L: Tensor) -> Tensor:
    """Upper triangles (N,6), order xx xy xz yy yz zz, of matrices (N,3,3)."""
    row, column = torch.triu_indices(3, 3, device=L.device)
    return L[:, row, column]


def strip_symmetric(sym: Tensor) -> Tensor:
    """Do as `strip_lowerdiag` for symmetric matrices (N,3,3), of which nothing is lost."""
    return strip_lowerdiag(sym)


def get_expon_lr_func(
    lr_init: float, lr_final: float, lr_delay_steps: int = 0, lr_delay_mult: float = 1.0, max_steps: int = 1_000_000
) -> Callable[[int], float]:
    """Learning rate by step: log-linear from lr_init to lr_final at max_steps, constant after; linear if one is 0.

    With lr_delay_steps, a quarter sine from lr_delay_mult up to 1 damps the start. The rate is 0 before step 0.
    """

    def rate(step: int) -> float:
        """Return the learning rate of a step, counted from 0."""
        if step < 0:
            return 0.0
        delay = 1.0
        if lr_delay_steps > 0:
            part = min(max(step / lr_delay_steps, 0.0), 1.0)
            delay = lr_delay_mult + (1 - lr_delay_mult) * float(np.sin(0.5 * np.pi * part))
        t = min(step / max_steps, 1.0)
        if lr_init == 0 or lr_final == 0:  # of which powers would be 0 from the first step on, or until the last
            return delay * (lr_init * (1 - t) + lr_final * t)
        return delay * lr_init ** (1 - t) * lr_final**t

    return rate


class _StampedOutput:
    """A text stream that appends the time, ` [dd/mm HH:MM:SS]`, to each line, or prints nothing if silent."""

    def __init__(self, stream: TextIO, silent: bool) -> None:
        self.stream = stream
        self.silent = silent

    def write(self, text: str) -> int:
        if not self.silent:
            self.stream.write(text.replace("\n", time.strftime(" [%d/%m %H:%M:%S]\n")))
        return len(text)

    def __getattr__(self, name: str) -> object:
        return getattr(self.stream, name)


def safe_state(silent: bool, seed: int = 0) -> None:
    """Seed Python, NumPy and torch, and stamp every line on stdout with the time (silent: drop stdout)."""
    stream = sys.stdout.stream if isinstance(sys.stdout, _StampedOutput) else sys.stdout
    sys.stdout = _StampedOutput(stream, silent)
    random.seed(seed)
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)
