"""Arguments and results of the operators: Gaussians with a camera, and the results of a forward."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from diff_gaussian_rasterization.alternatives import MOST_DEGREE, shaped
from diff_gaussian_rasterization.backend import OPERATORS
from diff_gaussian_rasterization.checks import check_flag
from diff_gaussian_rasterization.gaussians import Gaussians
from diff_gaussian_rasterization.lens import LENS_VALUES, Lens
from diff_gaussian_rasterization.settings import GaussianRasterizationSettings

PROJECTIONS = ("ewa", "ray")
_WIDEST = 1.35  # radians from the middle of a tile to its corners: tiles are seen as by pinholes
_USUAL = tuple(GaussianRasterizationSettings._field_defaults[name] for name in ("dilation", "near"))
_FLAGS = ("prefiltered", "debug", "antialiasing", "inverse_depth")

_NONE = torch.empty(0)  # stands for a tensor that is not given

# The inputs of `rasterize` that receive gradients, in the order of the operators' `wanted` and results.
GRADIENTS = ("means2d", *Gaussians._fields)


class Scene(NamedTuple):
    """Gaussians and camera, the first arguments of most operators (csrc/torch/scene.h)."""

    means: Tensor
    opacities: Tensor
    scales: Tensor | None
    rotations: Tensor | None
    cov3d: Tensor | None
    colors: Tensor | None
    sh_dc: Tensor | None
    sh_rest: Tensor | None
    view: Tensor
    projection: Tensor
    center: Tensor
    lens: tuple[float, ...]  # tan_x, tan_y, scale_modifier; perhaps Lens.numbers; perhaps dilation and near
    options: tuple[int, ...]  # height, width, sh_degree, antialiasing, raw (2: rotations alone); perhaps True: on rays

    @property
    def gaussians(self) -> tuple[Tensor | None, ...]:
        """The fields of `Gaussians`."""
        return self[:8]

    @property
    def camera(self) -> tuple:
        """The fields after those of `Gaussians`."""
        return self[8:]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the image."""
        return self.options[:2]

    @property
    def lists(self) -> tuple:
        """All fields, for an operator that takes lists of tensors, none of them None."""
        return [_NONE if t is None else t for t in self[:8]], self[8:11], self.lens, self.options


class Drawing(NamedTuple):
    """The results of the operator `rasterize`: planes of an image, and what its backward needs."""

    color: Tensor  # (3, H, W)
    transmittance: Tensor  # (1, H, W)
    inverse_depth: Tensor  # (1, H, W), or no rows if it is not wanted
    radii: Tensor  # (N,) int32
    splats: Tensor  # (N, 10), (N, 14) on rays, or (N, 24) on those of a lens
    tile_counts: Tensor  # (N,) int32
    instances: Tensor  # (I,) int32, the splats of all lists
    ranges: Tensor  # (tiles + 1,) int64, of each tile's list
    splat_slots: Tensor  # (N + 1, 2) int64
    slots: Tensor  # (S, 0) int32, whose length counts
    last: Tensor  # (H, W) int32, behind the last splat of a pixel in its tile's list
    layers: Tensor  # (V,), on a GPU

    def kept(self, background: Tensor) -> tuple[Tensor, ...]:
        """Return the tensors that the operators of the backward take as `source` (Kept in csrc/torch/backward.h)."""
        return *self[4:], background, self[1]


def scene_arguments(gaussians: Gaussians, settings: GaussianRasterizationSettings, raw: int) -> Scene:
    """Put Gaussians and camera into the form of the operators' arguments."""
    for name in _FLAGS:
        if (flag := getattr(settings, name)) is not True and flag is not False and flag is not None:
            check_flag(name, flag)  # the text "no" would count as True
    if settings.projection not in PROJECTIONS:
        raise ValueError(f"projection must be {' or '.join(map(repr, PROJECTIONS))}, got {settings.projection!r}")
    size = settings.image_height, settings.image_width
    tangents = (t.item() if isinstance(t, Tensor) else t for t in (settings.tanfovx, settings.tanfovy))
    lens = *tangents, settings.scale_modifier
    if settings.lens is not None:
        if not isinstance(settings.lens, Lens):
            raise ValueError(f"lens must be a Lens or None, got {settings.lens!r}")
        shown = settings.lens if settings.lens_values is None else _replace_values(settings.lens, settings.lens_values)
        lens += shown.numbers(*size[::-1])
        if settings.projection == "ray":
            check_rays(shown)
    if (settings.dilation, settings.near) != _USUAL:
        lens += float(settings.dilation), float(settings.near)
    place = settings.viewmatrix, settings.projmatrix, settings.campos
    camera = camera_arguments(*place, lens, *size, settings.sh_degree, settings.antialiasing, raw)
    scene = Scene(*gaussians, *camera)
    return scene._replace(options=(*scene.options, True)) if settings.projection == "ray" else scene


def check_rays(lens: Lens) -> None:
    """Refuse a lens whose pixels' rays the kernels do not find (ValueError)."""
    if lens.chart == "equirectangular" and any(lens.values[4:]):
        raise ValueError("projection='ray' has panoramas without distortion alone; take 'ewa'")
    if lens.chart != "perspective" and math.hypot(*(8 / focal for focal in lens.focal)) > _WIDEST:
        raise ValueError(f"projection='ray' needs tiles of 16 pixels to span under 150 degrees, got focal {lens.focal}")


def _replace_values(lens: Lens, values: Tensor) -> Lens:
    if not isinstance(values, Tensor) or values.shape != (LENS_VALUES,) or not values.is_floating_point():
        raise ValueError(f"lens_values must be a tensor of {LENS_VALUES} floats, those of Lens.values")
    return lens.with_values(values.tolist())


def camera_arguments(
    view: Tensor,
    projection: Tensor,
    center: Tensor,
    lens: tuple[float, ...],
    height: float,
    width: float,
    degree: int,
    antialiasing: bool | None,
    raw: int,
) -> tuple:
    """Return the fields of `Scene.camera`, from arguments in any form that the reference takes.

    The reference also takes further axes of length 1, whole floats, and a degree above 3, of which it draws 3.
    """
    size = [int(n) if isinstance(n, float) and n.is_integer() else n for n in (height, width)]
    options = (*size, min(degree, MOST_DEGREE), bool(antialiasing), raw)
    return shaped(view, 4, 4), shaped(projection, 4, 4), shaped(center, 3), lens, options


def draw(
    scene: Scene, background: Tensor, want_inverse_depth: bool = False, train: bool = True, awake: Tensor | None = None
) -> Drawing:
    """Call the operator `rasterize`.

    train: True if a backward will follow.
    awake: result of `wake_`, whose sleepers are left out.
    """
    options = want_inverse_depth, train, False, awake
    return Drawing(*OPERATORS.rasterize(None, *scene, shaped(background, 3), *options))
