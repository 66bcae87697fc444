"""Features that could cost something when they are off, each with the call that it is compared with.

To add a feature, write a function that takes a `Workload` and returns a `Row`, and list it in ROWS.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from diff_gaussian_rasterization import Gaussians, rasterize
from diff_gaussian_rasterization.ops import scene_arguments
from fused_ssim import fused_photometric_loss
from torch import Tensor

import train
from arguments import OptimizationParams, PipelineParams
from benchmarks.workloads.splat_scenes import frustum
from gaussian_renderer import render
from scene.cameras import MiniCam
from scene.gaussian_model import GaussianModel
from scene.gaussians.exposure import Exposures
from utils.loss_utils import photometric_loss

Call = Callable[[], object]


@dataclass
class Row:
    """A feature and the calls to compare."""

    feature: str
    compared: str  # describes base
    off: Call
    base: Call | None = None  # the call of code without the feature; None: no such call can be built
    on: Call | None = None  # None: such a call has nothing to switch on
    kept: tuple[int, int] = (0, 0)  # bytes that base and off keep after the call
    base_bytes: int | None = None  # bytes that base would allocate, counted by hand; None: measured from base


class Workload:
    """A model, a camera, an image to train on, and the operator's arguments as `render` would pass them."""

    def __init__(self, splats: int, width: int, height: int, sigma: float, device: torch.device) -> None:
        self.device = device
        self._zero = torch.zeros((), device=device)
        scene = frustum(splats, width, height, sigma).to(device)
        names = ("xyz", "opacity", "scaling", "rotation", "f_dc", "f_rest")
        self._rows = dict(zip(names, scene.parameters.values(), strict=True))
        self.settings = scene.settings(torch.float32)
        s = self.settings
        fov = [2 * torch.atan(torch.tensor(t)).item() for t in (s.tanfovy, s.tanfovx)]
        self.camera = MiniCam(width, height, *fov, 0.01, 100.0, s.viewmatrix, s.projmatrix)
        self.camera.camera_center = s.campos  # contiguous, as in Camera
        self.camera.exposure_name = "the view"
        generator = torch.Generator().manual_seed(1)
        self.target = torch.randint(0, 256, (3, height, width), dtype=torch.uint8, generator=generator).to(device)
        self.pipe = PipelineParams(argparse.ArgumentParser()).extract(argparse.Namespace())
        self.antialiased = argparse.Namespace(**vars(self.pipe) | {"antialiasing": True})

    def model(self, degree: int = 3, active: int = 3) -> GaussianModel:
        """Return a model ready for training with SH bands up to `degree`; those above `active` are zero."""
        rows = {name: values.clone() for name, values in self._rows.items()}
        rows["f_rest"] = rows["f_rest"][:, : (degree + 1) ** 2 - 1].contiguous()
        rows["f_rest"][:, (active + 1) ** 2 - 1 :] = 0
        model = GaussianModel(degree)
        model.set_rows(rows)
        model.active_sh_degree = active
        model.training_setup(OptimizationParams(argparse.ArgumentParser()).extract(argparse.Namespace()))
        model.limit_columns()  # as train.py does
        return model

    def image(self, model: GaussianModel, *, pipe: argparse.Namespace | None = None, **options: bool) -> Tensor:
        """Render as training and render.py do, with options of `render`; (3, H, W)."""
        options = {"want_depth": False, "want_visibility": False, "want_inactive_bands": False} | options
        return render(self.camera, model, pipe or self.pipe, self.settings.bg, **options)["render"]

    def bare_image(self, model: GaussianModel) -> Tensor:
        """Render the same image by the rasterizer alone, without anything that `render` adds."""
        means2d = self._zero.expand_as(model.get_xyz)
        means2d.requires_grad_(torch.is_grad_enabled())
        out = rasterize(
            model.get_xyz,
            means2d,
            settings=self.settings,
            **model.raw_geometry(),
            sh_dc=model.get_features_dc,
            sh_rest=model.get_features_rest,
            raw=True,
        )
        return out.color.clamp(0, 1)

    def step(self, model: GaussianModel) -> None:
        """Do a training step with learning rate 0, so that every step does the same work."""
        for group in model.optimizer.param_groups:
            group["lr"] = 0.0
        photometric_loss(self.image(model), self.target, 0.2)[0].backward()
        model.optimizer.step()
        model.optimizer.zero_grad(set_to_none=True)


def _backward(model: GaussianModel, image: Callable[[], Tensor]) -> None:
    image().sum().backward()
    model.optimizer.zero_grad(set_to_none=True)
    model.exposures.values.grad = None


def control(work: Workload) -> Row:
    """Compare a call with itself: the machine's noise in this table."""
    call = torch.no_grad()(partial(work.image, work.model()))
    return Row("nothing (control)", "the same render once more", call, call)


def depth(work: Workload) -> Row:
    model, off = work.model(), torch.no_grad()
    return Row(
        "depth and transmittance outputs",
        "the rasterizer's call alone, rendering",
        off(partial(work.image, model)),
        off(partial(work.bare_image, model)),
        off(partial(work.image, model, want_depth=True)),
    )


def gradient_buffers(work: Workload) -> Row:
    """Compare bytes with a count by hand.

    A splat has 10 values, a depth and 4 + 2 integers; an instance an index; a tile a range; a pixel colour and
    transmittance. On a GPU, projection writes a record of the same size in place of 4 of the integers.
    """
    model = work.model()
    with torch.no_grad():
        out = _operator(work, model, train=False)
    _, _, _, _, _, _, instances, ranges, _, _, _, _ = out
    a_splat = 40 + 4 + 16 + 8
    pixels = work.camera.image_width * work.camera.image_height
    needed = a_splat * len(model) + 4 * len(instances) + 8 * len(ranges) + 16 * pixels
    off = torch.no_grad()
    return Row(
        "gradient buffers at inference",
        "bytes: those of the image, counted by hand (without a GPU's scratch)",
        off(partial(_operator, work, model, train=False)),
        None,
        off(partial(_operator, work, model, train=True)),
        base_bytes=needed,
    )


def _operator(work: Workload, model: GaussianModel, train: bool) -> tuple[Tensor, ...]:
    colors = {"sh_dc": model.get_features_dc, "sh_rest": model.get_features_rest}
    gaussians = Gaussians(model.get_xyz, **model.raw_geometry(), **colors)
    settings = work.settings._replace(sh_degree=model.active_sh_degree)
    arguments = scene_arguments(gaussians, settings, raw=True)
    return torch.ops.diff_gaussian_rasterization.rasterize(model.get_xyz, *arguments, settings.bg, False, train)


def exposure(work: Workload) -> Row:
    model = work.model()
    model.exposures = Exposures([work.camera.exposure_name])
    return Row(
        "exposure compensation",
        "the rasterizer's call alone, with backward",
        partial(_backward, model, partial(work.image, model)),
        partial(_backward, model, partial(work.bare_image, model)),
        partial(_backward, model, partial(work.image, model, use_trained_exp=True)),
    )


def masks(work: Workload) -> Row:
    with torch.no_grad():
        image = work.image(work.model())
    image.requires_grad_()
    mask = torch.ones(1, *image.shape[1:], dtype=torch.bool, device=work.device)

    def loss(mask: Tensor | None = None) -> None:
        photometric_loss(image, work.target, 0.2, mask)[0].backward()
        image.grad = None

    def bare() -> None:
        fused_photometric_loss(image, work.target, 0.2)[0].backward()
        image.grad = None

    return Row("masks", "the fused kernel alone", loss, bare, partial(loss, mask))


def antialiasing(work: Workload) -> Row:
    model, off = work.model(), torch.no_grad()
    return Row(
        "antialiasing",
        "nothing: when off, one flag is read per splat",
        off(partial(work.image, model)),
        None,
        off(partial(work.image, model, pipe=work.antialiased)),
    )


def inactive_bands(work: Workload) -> Row:
    model, without = work.model(degree=3, active=0), work.model(degree=0, active=0)
    work.step(model), work.step(without)
    return Row(
        "SH bands above the active degree",
        "a training step of a model without the bands; bytes: values and moments",
        partial(work.step, model),
        partial(work.step, without),
        partial(work.step, work.model(degree=3, active=3)),
        kept=(_state_bytes(without), _state_bytes(model)),
    )


def unneeded_bands(work: Workload) -> Row:
    model = work.model(degree=3, active=1)
    model.active_sh_degree = 3  # as after loading a PLY
    pruned, off = model.part(slice(None), 1), torch.no_grad()
    return Row(
        "SH bands above the needed degree (1 of 3)",
        "a render of the model that --prune_sh gives; bytes: the PLY",
        off(partial(work.image, model)),
        off(partial(work.image, pruned)),
        kept=(pruned.ply_bytes, model.ply_bytes),
    )


def tensorboard(work: Workload) -> Row:
    scalar = torch.zeros((), device=work.device)

    def report() -> None:
        for iteration in range(1000):
            train.training_report(None, iteration, scalar, scalar, None, 0.0, [-1], None, None, ())

    def nothing() -> None:
        for _ in range(1000):
            pass

    return Row("TensorBoard and test scoring", "1,000 iterations of an empty loop", report, nothing)


def _state_bytes(model: GaussianModel) -> int:
    tensors = [group["params"][0] for group in model.optimizer.param_groups]
    tensors += [moment for state in model.optimizer.state.values() for moment in state.values()]
    return sum(t.numel() * t.element_size() for t in tensors)


ROWS: list[Callable[[Workload], Row]] = [
    control,
    depth,
    gradient_buffers,
    exposure,
    masks,
    antialiasing,
    inactive_bands,
    unneeded_bands,
    tensorboard,
]
