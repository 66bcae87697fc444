"""The rasterizer's calls on one scene, as training makes them, for timing."""

from collections.abc import Callable, Iterable

import fused_ssim  # noqa: F401  (registers its operators)
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, Gaussians, rasterize
from diff_gaussian_rasterization.ops import scene_arguments
from diff_gaussian_rasterization.scene import GRADIENTS, draw
from torch import Tensor

from tests.workloads.splat_scenes import PARAMETERS, SplatScene

OPS = torch.ops.diff_gaussian_rasterization
TILE = 16  # pixels


class Calls:
    """Forward alone, with backward, and a step of training, on raw parameters as in training."""

    def __init__(self, scene: SplatScene, dtype: torch.dtype = torch.float32, antialiasing: bool = False) -> None:
        """Make the inputs of the calls: parameters as leaves, settings, and the gradient of the image."""
        self.scene = scene
        self.leaves = scene.leaves(dtype)
        self.settings = scene.settings(dtype, antialiasing=antialiasing)
        self.means2d = torch.zeros_like(self.leaves["means"], requires_grad=True)
        self.gradient = image_gradient(scene).to(dtype)
        self._training: TrainingStep | None = None

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
        """Do a step of training, which leaves the scene as it was."""
        if self._training is None:
            self._training = TrainingStep(self.scene)
        self._training.take(self.settings)

    def clear(self) -> None:
        """Drop the gradients, as zero_grad(set_to_none=True) does."""
        for t in (self.means2d, *self.leaves.values()):
            t.grad = None

    def steps(self) -> dict[str, Callable[[], object]]:
        return {"forward": self.forward, "+ backward": self.with_backward, "step": self.step}


class TrainingStep:
    """Forward, L1 + D-SSIM against a random photo, and the backward with Adam and statistics, as training takes it.

    Learning rates are 0, so that every step meets the same Gaussians.
    """

    @torch.no_grad()
    def __init__(self, scene: SplatScene) -> None:
        """Make the photo, and Adam's averages and statistics of the Gaussians."""
        self._gaussians = {name: scene.parameters[name] for name in PARAMETERS}
        values, device = self._gaussians.values(), scene.parameters["means"].device
        generator = torch.Generator().manual_seed(1)
        self._photo = torch.rand(3, scene.height, scene.width, generator=generator).to(device)
        averages = [torch.full_like(value, 1e-6) for _ in range(2) for value in values]
        statistics = [torch.zeros(len(scene.parameters["means"]), device=device) for _ in range(3)]
        lists = averages, [torch.zeros(()) for _ in range(6)], statistics, []
        self._adam = *lists, list(range(6)), [0.0] * 6, [0.9, 0.999, 1e-15, 0.0, 0.0], [-1] * 6
        self._one = torch.ones((), device=device)

    @torch.no_grad()
    def take(self, camera: GaussianRasterizationSettings) -> None:
        """Take the step of a view."""
        scene = scene_arguments(Gaussians(**self._gaussians), camera, True)
        drawn = draw(scene, camera.bg)
        _, _, kept = torch.ops.fused_ssim.photometric(drawn.color, self._photo, 0.2, True)
        gradient = torch.ops.fused_ssim.photometric_vjp(drawn.color, self._photo, kept, 0.2, self._one)
        source = drawn.kept(camera.bg)
        OPS.apply_gradients_(*scene.lists, source, [gradient], drawn.radii, *self._adam)


# Of a training step: kernels that begin a stage, and those behind which another one begins.
BEGINS = {"project_kernel": "project", "blend_kernel": "blend", "blend_chunks_kernel": "blend"}
BEGINS |= {"l1_ssim_kernel": "loss", "project_vjp_kernel": "step"}
FOLLOWING = {"project_kernel": "bin", "l1_ssim_vjp_kernel": "blend_vjp"}
STAGES = ("project", "bin", "blend", "loss", "blend_vjp", "step")


def group_by_stage(launched: Iterable[tuple[str, float]]) -> list[tuple[str, str, float]]:
    """Return stage, name and time of each kernel of training steps."""
    stage, result = "project", []
    for name, milliseconds in launched:
        stage = BEGINS.get(name, stage)
        result.append((stage, name, milliseconds))
        stage = FOLLOWING.get(name, stage)
    return result


class Stages:
    """The operators of one forward and backward, each as a call of its own; none on the rays of a lens."""

    @torch.no_grad()
    def __init__(self, scene: SplatScene) -> None:
        """Run each operator once, and keep its inputs in `calls`, by the operator's name."""
        settings, size = scene.settings(torch.float32), (scene.height, scene.width)
        inputs = {name: scene.parameters[name] for name in PARAMETERS}
        arguments = scene_arguments(Gaussians(**inputs), settings, raw=True)
        wanted = [name in (*PARAMETERS, "means2d") for name in GRADIENTS]
        drawn = draw(arguments, settings.bg)
        padded = torch.nn.functional.pad(drawn.last, (0, -scene.width % TILE, 0, -scene.height % TILE))
        # Of each tile, the instances up to the last one that a pixel blends.
        self.processed = int(padded.unfold(0, TILE, TILE).unfold(1, TILE, TILE).amax((2, 3)).sum())
        self.instances, self.calls = drawn.instances, {}
        if settings.projection == "ray" and settings.lens is not None:
            return
        projected = OPS.project(*arguments)
        self.splats, counts = projected[0], projected[3]
        self.instances, self.ranges, *slots = OPS.bin(*projected[:4], *size, True)
        blend = (self.splats, self.instances, self.ranges, settings.bg, *size, False)
        _, left, _, self.last, layers = OPS.blend(*blend, True)
        kept = self.splats, counts, self.instances, self.ranges, *slots, self.last, layers, settings.bg, left
        gradient = image_gradient(scene)
        rows = self.splats, counts, *OPS.blend_rows(kept, gradient)
        self.calls: dict[str, Callable[[], object]] = {
            "project": lambda: OPS.project(*arguments),
            "bin": lambda: OPS.bin(*projected[:4], *size, True),
            "blend": lambda: OPS.blend(*blend, False),
            "blend_rows": lambda: OPS.blend_rows(kept, gradient),
            "rows_vjp": lambda: OPS.rasterize_vjp(*arguments, wanted, rows),
        }


def image_gradient(scene: SplatScene) -> Tensor:
    """Return normal numbers, (3, H, W), in place of a loss's gradient."""
    g = torch.Generator().manual_seed(0)
    return torch.randn(3, scene.height, scene.width, generator=g).to(scene.parameters["means"].device)
