"""The rasterizer's calls on one scene, as training makes them, for timing."""

from collections.abc import Callable

import torch
from diff_gaussian_rasterization import Gaussians, rasterize
from diff_gaussian_rasterization.ops import scene_arguments
from diff_gaussian_rasterization.optim import adam_
from diff_gaussian_rasterization.schema import GRADIENTS
from torch import Tensor

from benchmarks.workloads.splat_scenes import PARAMETERS, SplatScene

OPS = torch.ops.diff_gaussian_rasterization


class Calls:
    """Forward alone, with backward, and with a dense Adam step, on raw parameters as in training."""

    def __init__(self, scene: SplatScene, dtype: torch.dtype = torch.float32, antialiasing: bool = False) -> None:
        self.scene = scene
        self.leaves = scene.leaves(dtype)
        self.settings = scene.settings(dtype, antialiasing=antialiasing)
        self.means2d = torch.zeros_like(self.leaves["means"], requires_grad=True)
        self.gradient = image_gradient(scene).to(dtype)
        self._moments: list[list[Tensor]] = []

    def render(self) -> Tensor:
        """Return the image, (3, H, W)."""
        named = {name: self.leaves[name] for name in ("scales", "rotations", "sh_dc", "sh_rest")}
        means, opacities = self.leaves["means"], self.leaves["opacities"]
        return rasterize(means, self.means2d, opacities, self.settings, raw=True, **named).color

    @torch.no_grad()
    def forward(self) -> Tensor:
        return self.render()

    def with_backward(self) -> None:
        self.clear()
        self.render().backward(self.gradient)

    def step(self) -> None:
        """Do a step with learning rate 0, which has the arithmetic of a step but leaves the scene as it was."""
        self.with_backward()
        if not self._moments:
            self._moments = [[torch.zeros_like(t) for t in self.leaves.values()] for _ in range(2)]
        values = list(self.leaves.values())
        counters, n = [torch.zeros(()) for _ in values], len(values)
        with torch.no_grad():
            gradients = [t.grad for t in values]
            adam_(values, gradients, *self._moments, counters, [0.0] * n, 0.9, 0.999, 1e-15, [-1] * n)

    def clear(self) -> None:
        """Drop the gradients, as zero_grad(set_to_none=True) does."""
        for t in (self.means2d, *self.leaves.values()):
            t.grad = None

    def steps(self) -> dict[str, Callable[[], object]]:
        return {"forward": self.forward, "+ backward": self.with_backward, "step": self.step}


class Stages:
    """The operators of one forward and backward, each as a call of its own."""

    @torch.no_grad()
    def __init__(self, scene: SplatScene) -> None:
        settings, size = scene.settings(torch.float32), (scene.height, scene.width)
        inputs = {name: scene.parameters[name] for name in PARAMETERS}
        arguments = scene_arguments(Gaussians(**inputs), settings, raw=True)
        wanted = [name in (*PARAMETERS, "means2d") for name in GRADIENTS]
        projected = OPS.project(*arguments)
        self.splats, counts = projected[0], projected[3]
        self.instances, self.ranges, *slots = OPS.bin(*projected[:4], *size, True)
        blend = (self.splats, self.instances, self.ranges, settings.bg, *size, False)
        _, transmittance, _, self.last, _ = OPS.blend(*blend, True)
        state = (self.splats, self.instances, self.ranges, *slots, settings.bg, self.last)
        state += (transmittance, image_gradient(scene), None, None)
        moments = OPS.blend_vjp(*state)
        self.calls: dict[str, Callable[[], object]] = {
            "project": lambda: OPS.project(*arguments),
            "bin": lambda: OPS.bin(*projected[:4], *size, True),
            "blend": lambda: OPS.blend(*blend, False),
            "blend_vjp": lambda: OPS.blend_vjp(*state),
            "project_vjp": lambda: OPS.project_vjp(*arguments, counts, moments, wanted),
        }


def image_gradient(scene: SplatScene) -> Tensor:
    """Return normal numbers, (3, H, W), in place of a loss's gradient."""
    g = torch.Generator().manual_seed(0)
    return torch.randn(3, scene.height, scene.width, generator=g).to(scene.parameters["means"].device)
