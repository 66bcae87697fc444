"""Exact colours of some pixels of a view, in float64, with any order and any cut-offs.

The formulas are those of the oracle (diff_gaussian_rasterization.reference), which draws whole images. Here a pixel
knows its Gaussians one by one: alpha, colour, and two depths. One is that of the Gaussian's mean, by which the
rasterizer sorts. The other one is where the Gaussian is largest on the pixel's ray: on that ray, with the quantities of
reference/ray.py, squared distances from the mean are least at the depth z s / (s^2 + e q), z that of the mean. It
includes the dilation, so flat Gaussians seen from the side are nothing special.
"""

from typing import NamedTuple

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, Gaussians
from diff_gaussian_rasterization.reference.blend import LARGEST_ALPHA, LEAST_ALPHA, LEAST_TRANSMITTANCE
from diff_gaussian_rasterization.reference.camera import camera_of, project
from diff_gaussian_rasterization.reference.colour import seen_colors
from diff_gaussian_rasterization.reference.ray import Slopes, ray_shapes
from diff_gaussian_rasterization.reference.shape import activated, compensation, project_shapes
from torch import Tensor

from utils.system_utils import UserError

AT_ONCE = {"cpu": 2**22, "cuda": 2**27}  # Gaussians times pixels: 200 MB, and 6 GB


class Factor(NamedTuple):
    """Dilated covariances on the image as R^T R, R upper triangular, as in the oracle."""

    r11: Tensor  # (M,) px, as are the next two
    r12: Tensor
    r22: Tensor


class SortedView(NamedTuple):
    """The M Gaussians in front of a camera, nearest first, float64."""

    row: Tensor  # (M,) index in the model
    pixel: Tensor  # (M, 2) px
    depth: Tensor  # (M,) of the means
    ellipses: Factor  # by which alphas are computed
    on_ray: Factor  # those of rays; the same with projection "ray"
    slopes: Slopes
    opacity: Tensor  # (M,)
    color: Tensor  # (M, 3)
    projection: str
    background: Tensor  # (3,)


class Layers(NamedTuple):
    """Up to K Gaussians at each of P pixels, by the depths of their means; the rest has alpha 0."""

    which: Tensor  # (P, K) places in the view
    alpha: Tensor  # (P, K), at most 0.99
    color: Tensor  # (P, K, 3)
    depth: Tensor  # (P, K) of the mean; infinite beyond a pixel's last Gaussian, as is the next
    along: Tensor  # (P, K) where the Gaussian is largest on the pixel's ray, 0 if that is behind the camera


def sorted_view(gaussians: Gaussians, settings: GaussianRasterizationSettings, projection: str) -> SortedView:
    """What a pinhole camera sees of raw Gaussians. UserError for another lens."""
    if settings.lens is not None:
        raise UserError("pixels are sampled through pinholes only; train with --lenses undistort")
    with torch.device(gaussians.means.device):
        camera = camera_of(settings)
        exact = activated(Gaussians(*(None if values is None else values.double() for values in gaussians)))
        points = project(exact.means, torch.zeros_like(exact.means), camera)
        on_ray, slopes = ray_shapes(exact, points, camera, settings.scale_modifier)
        ellipses = on_ray
        if projection == "ewa":
            ellipses = project_shapes(exact, points, camera, settings.scale_modifier)
        opacity = exact.opacities.reshape(-1)
        if settings.antialiasing:
            opacity = opacity * compensation(ellipses)
        color = seen_colors(exact, camera, settings.sh_degree)
    finite = torch.stack([*points.pixel.unbind(1), ellipses.r11, ellipses.r22, opacity, *color.unbind(1)]).isfinite()
    shown = (points.in_front & finite.all(0)).nonzero()[:, 0]
    row = shown[torch.argsort(points.depth[shown], stable=True)]
    ellipses, on_ray = (Factor(*(getattr(shape, name)[row] for name in Factor._fields)) for shape in (ellipses, on_ray))
    slopes = Slopes(slopes.g[row], slopes.e[row], None)
    where = points.pixel[row], points.depth[row]
    return SortedView(row, *where, ellipses, on_ray, slopes, opacity[row], color[row], projection, settings.bg.double())


def layers(view: SortedView, pixels: Tensor, least: float = LEAST_ALPHA) -> Layers:
    """The Gaussians whose alpha at pixels (P, 2), x and y, is at least `least`. They need not be whole."""
    pixels = pixels.to(view.pixel)
    at_once = max(1, AT_ONCE[pixels.device.type] // max(1, len(view.row)))
    found = [_reaching(view, some, least) for some in pixels.split(at_once)]
    count = max(int(reached[1].max()) if len(reached[1]) else 0 for reached in found)
    parts = [_layers(view, some, *reached, count) for some, reached in zip(pixels.split(at_once), found, strict=True)]
    return Layers(*(torch.cat(values) for values in zip(*parts, strict=True)))


def _reaching(view: SortedView, pixels: Tensor, least: float) -> tuple[Tensor, Tensor]:
    """Places of the Gaussians that reach pixels (P, 2), pixel after pixel and by depth, and how many they are (P,)."""
    reached = _distance(view, pixels, slice(None)) <= 2 * torch.log(view.opacity / least)
    return reached.nonzero()[:, 1], reached.sum(1)


def _layers(view: SortedView, pixels: Tensor, places: Tensor, counts: Tensor, count: int) -> Layers:
    used = torch.arange(count, device=pixels.device) < counts[:, None]
    which = torch.zeros_like(used, dtype=torch.int64).masked_scatter_(used, places)
    square = _distance(view, pixels, which)
    alpha = (view.opacity[which] * torch.exp(-0.5 * square)).clamp(max=LARGEST_ALPHA)
    depth, along = (torch.where(used, t, torch.inf) for t in (view.depth[which], depths_on_rays(view, pixels, which)))
    return Layers(which, torch.where(used, alpha, 0.0), view.color[which], depth, along)


def _offsets(view: SortedView, pixels: Tensor, which: Tensor | slice) -> tuple[Tensor, Tensor]:
    """From the means of Gaussians (P, K), or of all, to pixels (P, 2), px."""
    x, y = pixels.T[..., None]
    return x - view.pixel[:, 0][which], y - view.pixel[:, 1][which]


def _whitened(shape: Factor, which: Tensor | slice, dx: Tensor, dy: Tensor) -> Tensor:
    """q: the squared distance of an offset in deviations of the ellipse."""
    u = dx / shape.r11[which]
    v = (dy - shape.r12[which] * u) / shape.r22[which]
    return u * u + v * v


def _along(view: SortedView, which: Tensor | slice, dx: Tensor, dy: Tensor) -> Tensor:
    """s of reference/ray.py at offsets."""
    return 1 + view.slopes.g[:, 0][which] * dx + view.slopes.g[:, 1][which] * dy


def _distance(view: SortedView, pixels: Tensor, which: Tensor | slice) -> Tensor:
    """D^2, by which alpha is opacity times exp(-D^2 / 2), at pixels (P, 2) of Gaussians (P, K), or of all: (P, M)."""
    dx, dy = _offsets(view, pixels, which)
    q = _whitened(view.ellipses, which, dx, dy)
    if view.projection == "ewa":
        return q
    s = _along(view, which, dx, dy)
    return torch.where(s > 0, q / (s * s + view.slopes.e[which] * q), torch.inf)


def depths_on_rays(view: SortedView, pixels: Tensor, which: Tensor) -> Tensor:
    """Where Gaussians (P, K) are largest on the rays of pixels (P, 2): (P, K) depths, 0 if behind the camera."""
    dx, dy = _offsets(view, pixels, which)
    q, s = _whitened(view.on_ray, which, dx, dy), _along(view, which, dx, dy)
    return (view.depth[which] * s / (s * s + view.slopes.e[which] * q)).clamp(min=0)


def blended(
    found: Layers, background: Tensor, keys: Tensor | None = None, stop: float = LEAST_TRANSMITTANCE
) -> tuple[Tensor, Tensor]:
    """Colours (P, 3), and which layers (P, K) have a part in them.

    keys (P, K): blend by these, the least first, instead of by the depths of the means. stop: the transmittance that a
    blended layer leaves at least.
    """
    order = None if keys is None else torch.argsort(keys, dim=1, stable=True)
    alpha = found.alpha if order is None else found.alpha.gather(1, order)
    color = found.color if order is None else found.color.gather(1, order[..., None].expand(-1, -1, 3))
    used = (alpha > 0) & (torch.cumprod(1 - alpha, 1) >= stop)
    alpha = torch.where(used, alpha, 0.0)
    left = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones_like(left[:, :1]), left], 1)
    colors = ((alpha * before[:, :-1])[..., None] * color).sum(1) + before[:, -1:] * background
    return colors, used if order is None else torch.zeros_like(used).scatter_(1, order, used)


def random_pixels(settings: GaussianRasterizationSettings, count: int, seed: int) -> Tensor:
    """Pixels (count, 2), x and y, all over the image, on the device of the settings."""
    draw = torch.Generator().manual_seed(seed)
    size = settings.image_width, settings.image_height
    chosen = [torch.randint(0, limit, (count,), generator=draw) for limit in size]
    return torch.stack(chosen, 1).to(settings.viewmatrix.device)
