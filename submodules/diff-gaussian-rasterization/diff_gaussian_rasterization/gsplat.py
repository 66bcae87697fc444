"""gsplat's function `rasterization`, in the form of its version 1.5.3, on this rasterizer: CPU and CUDA.

    from diff_gaussian_rasterization.gsplat import rasterization
    python -m diff_gaussian_rasterization.gsplat PROGRAM.py [OPTION...]    # runs a program whose gsplat is this one

Names, order, defaults, shapes and results are gsplat's; what it does not have is refused by name. An alpha is at most
0.99, where gsplat has 0.999, and keeps its gradient there.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diff_gaussian_rasterization.channels import ChannelImage, rasterize_channels
from diff_gaussian_rasterization.lens import Lens
from diff_gaussian_rasterization.settings import GaussianRasterizationSettings

MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
MOST_BANDS = 3  # the highest degree of SH
_NEAR = 0.2  # of the kernels: kNear in csrc/math/constants.h
_LARGEST = 2.0**20  # a scene enlarged by far more overflows
_DILATION = 0.3  # kDilation
_HALF_LOG2E = 0.5 / math.log(2)
_MIN_ALPHA = 1 / 255
_FLAT = 2.0**-40  # of depth
_SIGMAS = 3.33  # of an opaque Gaussian, beyond which its alpha is below 1/255
_UNSUPPORTED = {
    "distributed": "train with torchrun and train.py",
    "with_ut": "take camera_model='fisheye', or a Lens with rasterize_channels",
    "with_eval3d": "take projection='ray' with rasterize",
    "sparse_grad": "leave it out: gradients are dense",
}
_NEED_UT = ("radial_coeffs", "tangential_coeffs", "thin_prism_coeffs", "ftheta_coeffs", "viewmats_rs")


class _Fisheye(Lens):
    """An equidistant lens that shows Gaussians whose centres are up to 90 degrees off the axis, as gsplat does."""

    def numbers(self, width: int, height: int) -> tuple[float, ...]:
        chart, _, reach, _, *rest = super().numbers(width, height)
        return chart, (math.pi / 2) ** 2, reach, math.pi / 2, *rest


class _Camera(NamedTuple):
    """One camera of a call."""

    view: Tensor  # (4, 4) world to view
    K: Tensor  # (3, 3)
    width: int
    height: int
    model: str
    near: float
    far: float

    def settings(
        self, scale: float, degree: int, antialiased: bool, background: Tensor
    ) -> GaussianRasterizationSettings:
        """The settings of a scene that is scaled. All are differentiable in `view`."""
        view = self.view * torch.cat([self.view.new_ones(4, 3), self.view.new_tensor([[scale]] * 3 + [[1]])], 1)
        if self.model == "ortho":  # a pinhole for which all is at the same depth, up to rounding
            view = torch.cat([view[:2], _FLAT * view[2:3] + view.new_tensor([[0, 0, 0, 1]]), view[3:]])
        (fx, _, cx), (_, fy, cy), _ = self.K.tolist()
        projection = self.view.new_zeros(4, 4)
        projection[0, 0], projection[1, 1] = 2 * fx / self.width, 2 * fy / self.height
        projection[0, 2], projection[1, 2] = 2 * cx / self.width - 1, 2 * cy / self.height - 1
        projection[2, 2] = projection[3, 2] = 1
        chart = {"fisheye": partial(_Fisheye, "equidistant"), "ortho": partial(Lens, "perspective")}.get(self.model)
        lens = chart and chart((fx, fy), (cx - 0.5, cy - 0.5))
        tangents = self.width / (2 * fx), self.height / (2 * fy)
        center = scale * torch.linalg.inv(self.view)[:3, 3]
        full = (projection @ view).T
        return GaussianRasterizationSettings(
            self.height, self.width, *tangents, background, 1.0, view.T, full, degree, center, False, False,
            antialiased, lens=lens,
        )  # fmt: skip


class _Rows(NamedTuple):
    """The N Gaussians of an image."""

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    opacities: Tensor
    covars: Tensor | None
    colors: Tensor  # (N, D), or SH (N, K, 3)


class _Options(NamedTuple):
    """How to draw them."""

    degree: int | None  # of SH
    mode: str
    antialiased: bool
    absgrad: bool
    clip: float  # px


class _Projected(NamedTuple):
    """What gsplat tells of the N Gaussians of an image."""

    radii: Tensor  # (N, 2) int32, px
    means2d: Tensor  # (N, 2) px, pixel centres at halves
    depths: Tensor  # (N,)
    conics: Tensor  # (N, 3): xx, xy, yy of the inverse covariance
    opacities: Tensor  # (N,), of antialiased ones with their factor
    tiles: Tensor  # (N,) int32


def rasterization(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any = None,
    rolling_shutter: Any = None,
    viewmats_rs: Tensor | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Renders N Gaussians with C cameras, and leading batch dimensions, as gsplat 1.5.3 does.

    means (..., N, 3); quats (..., N, 4): w x y z, any length; scales (..., N, 3), or covars (..., N, 3, 3) in place of
    both; opacities (..., N). colors (..., N, D) or (..., C, N, D); with sh_degree, at most 3, SH (..., N, K, 3) or
    (..., C, N, K, 3). viewmats (..., C, 4, 4): world to view, differentiable. Ks (..., C, 3, 3): no gradient.
    near_plane, far_plane: depths that are shown. radius_clip: Gaussians of radii up to it (px) are left out.
    backgrounds (..., C, D). render_mode: RGB, D (the sum of weights times depth), ED (D over alpha), or both.
    absgrad: meta["means2d"].absgrad gets absolute gradients, of at most four channels; x has the length of x and y in
    NDC, times 2 / width, and y is 0. Returns images (..., C, H, W, D), alphas (..., C, H, W, 1) and meta, whose means2d
    gets a `grad` (px) in backward(). Raises ValueError for what is not supported, and for wrong shapes.
    """
    given = {name: value for name, value in locals().items() if name in _UNSUPPORTED or name in _NEED_UT}
    _refuse(given, rolling_shutter, render_mode, camera_model, rasterize_mode, eps2d, sh_degree)
    given = means, quats, scales, opacities, covars, colors, viewmats, Ks, backgrounds
    form = (*means.shape[:-2], viewmats.shape[-3] if viewmats.dim() > 2 else 1)
    options = _Options(sh_degree, render_mode, rasterize_mode == "antialiased", absgrad, radius_clip)
    with torch.autocast(means.device.type, enabled=False):  # its products of matrices are of 8 or 11 bits
        drawn = [
            _render(_Camera(view, K, width, height, camera_model, near_plane, far_plane), rows, background, options)
            for rows, view, K, background in _images(*given, form[-1], sh_degree is not None)
        ]
    images, alphas, found, probes = zip(*drawn, strict=True)
    meta = _meta(found, probes, form, (width, height), tile_size, packed, absgrad)
    return torch.stack(images).unflatten(0, form), torch.stack(alphas).unflatten(0, form), meta


def _images(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    covars: Tensor | None,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    backgrounds: Tensor | None,
    cameras: int,
    harmonics: bool,
) -> Iterator[tuple[_Rows, Tensor, Tensor, Tensor | None]]:
    """For each image the Gaussians, view, intrinsics and background. ValueError for wrong shapes and types."""
    batch, count = means.shape[:-2], means.shape[-2]
    if not (cameras and all(batch)):
        raise ValueError(f"there must be an image to render, got batches and cameras {(*batch, cameras)}")
    each = colors.dim() - len(batch) == 3 + harmonics  # colours of their own for each camera
    shapes = {
        "means": (means, (count, 3)),
        "opacities": (opacities, (count,)),
        "viewmats": (viewmats, (cameras, 4, 4)),
        "Ks": (Ks, (cameras, 3, 3)),
        "colors": (colors, ((cameras,) if each else ()) + (count, *colors.shape[-1 - harmonics :])),
    }
    if covars is None:
        shapes |= {"quats": (quats, (count, 4)), "scales": (scales, (count, 3))}
    else:
        shapes |= {"covars": (covars, (count, 3, 3))}
        quats = scales = None
    if backgrounds is not None:
        shapes |= {"backgrounds": (backgrounds, (cameras, backgrounds.shape[-1]))}
    for name, (values, shape) in shapes.items():
        if values is None or values.shape != batch + shape:
            found = None if values is None else tuple(values.shape)
            raise ValueError(f"{name} must be {tuple(batch + shape)}, got {found}")
        if values.dtype != means.dtype and name not in ("Ks", "backgrounds"):
            raise ValueError(f"{name} must be {means.dtype} like means, got {values.dtype}")

    def item(values: Tensor | None, axes: int, batch: int) -> Tensor | None:
        return None if values is None else values.reshape(batches, *values.shape[values.dim() - axes :])[batch]

    batches = math.prod(batch)
    for at in range(batches):
        rows = [(means, 2), (quats, 2), (scales, 2), (opacities, 1), (covars, 3)]
        own = [item(values, axes, at) for values, axes in rows]
        shown, views, intrinsics = (
            item(colors, 2 + harmonics + each, at), item(viewmats, 3, at), item(Ks, 3, at)
        )  # fmt: skip
        behind = item(backgrounds, 2, at)
        for n in range(cameras):
            background = None if behind is None else behind[n]
            yield _Rows(*own, shown[n] if each else shown), views[n], intrinsics[n], background


def _refuse(given: dict, shutter: Any, mode: str, model: str, rasterize_mode: str, eps2d: float, degree: Any) -> None:
    for name, remedy in _UNSUPPORTED.items():
        if given[name]:
            raise ValueError(f"{name} is not supported; {remedy}")
    for name in _NEED_UT:
        if given[name] is not None:
            raise ValueError(f"{name} is not supported; {_UNSUPPORTED['with_ut']}")
    if shutter is not None and getattr(shutter, "name", "GLOBAL") != "GLOBAL":
        raise ValueError("rolling_shutter is not supported; take poses of a global shutter")
    if mode not in MODES:
        raise ValueError(f"render_mode must be one of {', '.join(MODES)}, got {mode!r}")
    if model not in ("pinhole", "fisheye", "ortho"):
        raise ValueError(f"camera_model {model!r} is not supported; take pinhole, fisheye or ortho")
    if rasterize_mode not in ("classic", "antialiased"):
        raise ValueError(f"rasterize_mode must be classic or antialiased, got {rasterize_mode!r}")
    if eps2d != _DILATION:
        raise ValueError(f"eps2d must be {_DILATION}, got {eps2d}")
    if degree is not None and not 0 <= degree <= MOST_BANDS:
        raise ValueError(f"sh_degree must be 0 to {MOST_BANDS}, got {degree}")


def _render(
    camera: _Camera, rows: _Rows, background: Tensor | None, options: _Options
) -> tuple[Tensor, Tensor, _Projected, Tensor]:
    """An image (H, W, D), its alpha (H, W, 1), what is told of the Gaussians, and the tensor that gets d means2d."""
    # The kernels cull at 0.2. To show nearer things, enlarge the scene, by a power of two so that no bit changes.
    nearest = max(camera.near, _NEAR / _LARGEST)
    scale = 1.0 if camera.model == "ortho" else 2.0 ** max(0, math.ceil(math.log2(_NEAR / nearest)))
    depth = rows.means @ camera.view[2, :3] + camera.view[2, 3]
    visible = ((depth > camera.near) & (depth < camera.far)).detach()
    gaussians, features = _scaled(rows, scale, options), []
    if options.mode.startswith("RGB") and options.degree is None:
        features.append(rows.colors)
    if options.mode.endswith("D"):
        features.append(depth[:, None])
    count = sum(part.shape[1] for part in features) + 3 * ("sh_dc" in gaussians)
    behind = rows.means.new_zeros(count)  # also of depth
    if background is not None and options.mode.startswith("RGB"):
        behind = torch.nn.functional.pad(background, (0, options.mode.endswith("D")))
    wanted = any(values is not None and values.requires_grad for values in (*rows, camera.view, background))
    probe = torch.zeros_like(rows.means, requires_grad=wanted and torch.is_grad_enabled())
    out = rasterize_channels(
        rows.means * scale,
        probe,
        torch.where(visible, rows.opacities, 0),
        camera.settings(scale, options.degree or 0, options.antialiased, behind),
        features=torch.cat(features, 1) if features else None,
        depths=depth.detach(),
        want_absolute_gradient=options.absgrad,
        **gaussians,
    )
    projected = _projected(out, depth.detach(), visible)
    small = (projected.radii > 0).all(1) & (projected.radii <= options.clip).all(1)
    if options.clip > 0 and small.any():
        rest = rows._replace(opacities=torch.where(small, 0, rows.opacities))
        return _render(camera, rest, background, options._replace(clip=0.0))
    image, alpha = out.image.permute(1, 2, 0), 1 - out.transmittance.permute(1, 2, 0)
    if options.mode.endswith("ED"):
        image = torch.cat([image[..., :-1], image[..., -1:] / alpha.clamp_min(1e-10)], -1)
    return image, alpha, projected, probe


def _scaled(rows: _Rows, scale: float, options: _Options) -> dict[str, Tensor]:
    """Shapes in a scene that is so many times as large, and SH, by the names of `Gaussians`."""
    if rows.covars is None:
        shape = {"scales": rows.scales * scale, "rotations": torch.nn.functional.normalize(rows.quats, dim=-1)}
    else:
        places = (0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)
        shape = {"cov3d": torch.stack([rows.covars[:, i, j] for i, j in places], 1) * scale**2}
    if options.mode.startswith("RGB") and options.degree is not None:
        shape |= {
            "sh_dc": rows.colors[:, :1].contiguous(),
            "sh_rest": rows.colors[:, 1 : (MOST_BANDS + 1) ** 2].contiguous(),
        }
    return shape


@torch.no_grad()
def _projected(out: ChannelImage, depth: Tensor, visible: Tensor) -> _Projected:
    """From rows of splats. log2(alpha) = log2_opacity - |L d|^2, with L upper triangular (csrc/math/footprint.h)."""
    x, y, l11, l12, l22, log2_opacity = out.splats[:, :6].unbind(1)
    l11 = l11.abs()
    conics = torch.stack([l11 * l11, l11 * l12, l12 * l12 + l22 * l22], 1) / _HALF_LOG2E
    opacity = log2_opacity.exp2()
    sigmas = (2 * (opacity / _MIN_ALPHA).log()).clamp_min(0).sqrt().clamp_max(_SIGMAS)
    across = _HALF_LOG2E**0.5 * torch.stack([torch.hypot(1 / l11, l12 / (l11 * l22)), 1 / l22], 1)
    radii = (sigmas[:, None] * across).ceil()
    means2d = torch.stack([x, y], 1) + 0.5
    shown = visible & (out.tile_counts > 0)  # rows of others are zero
    radii = torch.where(shown[:, None], radii, 0).int()
    return _Projected(radii, means2d, depth, conics, opacity, out.tile_counts)


def _meta(
    found: Sequence[_Projected],
    probes: Sequence[Tensor],
    form: tuple[int, ...],
    size: tuple[int, int],
    tile: int,
    packed: bool,
    absgrad: bool,
) -> dict[str, Any]:
    """The notes, in which means2d gets `grad`, and `absgrad`, when the gradients of its parts are known."""
    all_of = _Projected(*map(torch.stack, zip(*found, strict=True)))
    count, ids = all_of.radii.shape[1], dict.fromkeys(("batch_ids", "camera_ids", "gaussian_ids"))
    place = None
    if packed:
        place = (all_of.radii > 0).all(-1).nonzero(as_tuple=True)
        image, gaussian = place
        ids = {"batch_ids": image // form[-1], "camera_ids": image % form[-1], "gaussian_ids": gaussian}
        values = _Projected(*(part[place] for part in all_of))
    else:
        values = _Projected(*(part.reshape(*form, count, *part.shape[2:]) for part in all_of))
    means2d = values.means2d.clone().requires_grad_(probes[0].requires_grad)
    if means2d.requires_grad:
        for n, probe in enumerate(probes):
            probe.register_hook(_collector(means2d, n, place, absgrad, size))
    notes = {"radii": values.radii, "means2d": means2d, "depths": values.depths, "conics": values.conics}
    notes |= {"opacities": values.opacities, "tiles_per_gauss": values.tiles}
    (width, height), across, down = size, *(-(-pixels // tile) for pixels in size)
    sizes = {"width": width, "height": height, "tile_size": tile, "tile_width": across, "tile_height": down}
    return ids | notes | sizes | {"n_batches": math.prod(form[:-1]), "n_cameras": form[-1]}


def _collector(
    means2d: Tensor, image: int, place: tuple[Tensor, Tensor] | None, absgrad: bool, size: tuple[int, int]
) -> Callable[[Tensor], None]:
    """What puts the gradients of an image's means, which are per NDC unit, into `means2d`."""

    def collect(gradient: Tensor) -> None:
        per_pixel = 2 / gradient.new_tensor(size)
        length = torch.nn.functional.pad(gradient[:, 2:], (0, 1))
        for name, values in (("grad", gradient[:, :2]), ("absgrad", length))[: 1 + absgrad]:
            if getattr(means2d, name, None) is None:
                setattr(means2d, name, torch.zeros_like(means2d))
            into = getattr(means2d, name)
            if place is None:
                into.flatten(0, -3)[image] += values * per_pixel
            else:
                own = place[0] == image
                into[own] += (values * per_pixel)[place[1][own]]

    return collect


if __name__ == "__main__":
    from diff_gaussian_rasterization.gsplat_programs import run

    run()
