"""One checkout's part of benchmarks.kernels.cpu_stages, which runs it as the text of a program.

The argument is a file with the views. For each view number on stdin, does one training iteration's calls on that view
and writes the milliseconds of each as a line of JSON.
"""

import json
import sys
import time

import torch
from diff_gaussian_rasterization.optim import adam_
from diff_gaussian_rasterization.schema import GRADIENTS, SCENE, SCENE_TENSORS
from fused_ssim import fused_photometric_loss

OPS = torch.ops.diff_gaussian_rasterization


class Iteration:
    """The calls on one view in the order of an iteration. Learning rates are 0, so that it can be repeated."""

    def __init__(self, arguments: tuple, photo: torch.Tensor) -> None:
        self.arguments, self.photo = arguments, photo
        names = SCENE[:SCENE_TENSORS]
        self.values = {n: t for n, t in zip(names, arguments, strict=False) if n in GRADIENTS and t is not None}
        self.wanted = [name in self.values or name == "means2d" for name in GRADIENTS]
        self.size = photo.shape[-2:]
        self.background = torch.zeros(3)
        self.moments = [[torch.zeros_like(t) for t in self.values.values()] for _ in range(2)]
        self.took: dict[str, float] = {}

    def call(self, stage: str, function, *arguments):
        start = time.perf_counter()
        out = function(*arguments)
        self.took[stage] = 1e3 * (time.perf_counter() - start)
        return out

    def loss_gradient(self, image: torch.Tensor) -> torch.Tensor:
        image.requires_grad_()
        with torch.enable_grad():
            fused_photometric_loss(image, self.photo, 0.2)[0].backward()
        return image.grad

    def adam(self, gradients: list[torch.Tensor]) -> None:
        values, n = list(self.values.values()), len(self.values)
        adam_(
            values, gradients, *self.moments, [torch.zeros(()) for _ in values], [0.0] * n, 0.9, 0.999, 1e-15, [-1] * n
        )

    @torch.no_grad()
    def run(self) -> dict[str, float]:
        """Do the calls; return their milliseconds."""
        projected = self.call("project", OPS.project, *self.arguments)
        binned = self.call("bin", OPS.bin, *projected[:4], *self.size, True)
        lists = (projected[0], *binned[:2], self.background)
        color, transmittance, _, last = self.call("blend", OPS.blend, *lists, *self.size, False, True)
        gradient = self.call("L1 + SSIM", self.loss_gradient, color)
        state = (projected[0], *binned, self.background, last, transmittance, gradient, None, None)
        moments = self.call("blend_vjp", OPS.blend_vjp, *state)
        gradients = self.call("project_vjp", OPS.project_vjp, *self.arguments, projected[3], moments, self.wanted)
        of_values = [g for name, g in zip(GRADIENTS, gradients, strict=True) if name in self.values]
        self.call("Adam", self.adam, of_values)
        del projected, binned, lists, color, state, moments, gradients, of_values
        means = self.arguments[0]
        out = self.call("forward", OPS.rasterize, means, *self.arguments, self.background, False, True)
        state = (*out[4:5], *out[6:10], self.background, out[10], out[1], gradient, None, None)
        more = (out[5], *out[11:])  # older versions have no layers
        self.call("backward", OPS.rasterize_vjp, *self.arguments, *state, *more, self.wanted)
        return self.took


def main() -> None:
    views = [Iteration(*view) for view in torch.load(sys.argv[1])]
    for line in sys.stdin:
        print(json.dumps(views[int(line)].run()), flush=True)
