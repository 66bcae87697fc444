"""gsplat's function `rasterization`, in the form of its version 1.5.3, on this rasterizer: CPU and CUDA.

    from diff_gaussian_rasterization.gsplat import rasterization
    python -m diff_gaussian_rasterization.gsplat PROGRAM.py [OPTION...]    # runs a program whose gsplat is this one

Names, order, defaults, shapes and results are gsplat's; what it does not have is refused by name.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diff_gaussian_rasterization.alternatives import MOST_BANDS, MOST_DEGREE
from diff_gaussian_rasterization.backend import OPERATORS
from diff_gaussian_rasterization.channels import rasterize_channels
from diff_gaussian_rasterization.checks import check_tensors, whole_number
from diff_gaussian_rasterization.lens import Lens
from diff_gaussian_rasterization.settings import GaussianRasterizationSettings

MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
_CHOICES = {
    "render_mode": MODES,
    "camera_model": ("pinhole", "fisheye", "ortho"),
    "rasterize_mode": ("classic", "antialiased"),
}
_ENDLESS = 1e10  # far_plane, if nobody gives one
_MOST_ALPHA = 0.999
_FLAT = 2.0**-40  # of depth
_NO_UT = "take camera_model='fisheye', or a Lens with rasterize_channels"
_UNSUPPORTED = {
    "distributed": "train with torchrun and train.py",
    "with_ut": _NO_UT,
    "with_eval3d": "take projection='ray' with rasterize",
    **dict.fromkeys(
        ("radial_coeffs", "tangential_coeffs", "thin_prism_coeffs", "ftheta_coeffs", "viewmats_rs"), _NO_UT
    ),
}
_NEEDED = {"means": "(..., N, 3)", "colors": "(..., N, D)", "viewmats": "(..., C, 4, 4)"}
_OTHERS = ("quats", "scales", "opacities", "Ks", "backgrounds", "covars")


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
        self, degree: int | None, antialiased: bool, dilation: float, background: Tensor
    ) -> GaussianRasterizationSettings:
        """The settings, differentiable in `view`. Of a pinhole no number goes to the host, which would wait for it."""
        view, width, height = self.view.double(), self.width, self.height
        center = torch.linalg.inv_ex(view)[0][:3, 3] if degree else view[:3, 3]  # SH of degree 0 have no direction
        lens, near = None, self.near
        if self.model != "pinhole":
            fx, _, cx, _, fy, cy, *_ = self.K.flatten().tolist()
            lens = (_Fisheye if self.model == "fisheye" else Lens)(
                "equidistant" if self.model == "fisheye" else "perspective", (fx, fy), (cx - 0.5, cy - 0.5)
            )
        if self.model == "ortho":  # a pinhole for which all is at the same depth, up to rounding
            view, near = torch.cat([view[:2], _FLAT * view[2:3] + view.new_tensor([[0, 0, 0, 1]]), view[3:]]), 0.0
        kept, last, clip = _of_pixels(width, height, view.device)
        full = view[:3].T @ torch.addcmul(last, self.K.double(), kept).T @ clip
        matrices = torch.cat([view.T.flatten(), full.flatten(), center]).to(self.view.dtype)
        return GaussianRasterizationSettings(
            height, width, 0.0, 0.0, background, 1.0, matrices[:16].view(4, 4), matrices[16:32].view(4, 4),
            degree or 0, matrices[32:], False, False, antialiased, lens=lens, dilation=dilation, near=near,
        )  # fmt: skip


@lru_cache
def _of_pixels(width: int, height: int, device: torch.device) -> list[Tensor]:
    """What K makes a projection with: its entries that count (3, 3), as in gsplat, and the others.

    Then from pixels times depth to clip coordinates, transposed (3, 4).
    """
    clip = [[2 / width, 0, 0, 0], [0, 2 / height, 0, 0], [-1, -1, 1, 1]]
    kept, last = [[1, 0, 1], [0, 1, 1], [0, 0, 0]], [[0, 0, 0], [0, 0, 0], [0, 0, 1]]
    return [torch.tensor(rows, dtype=torch.float64, device=device) for rows in (kept, last, clip)]


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
    dilation: float  # px^2
    absgrad: bool
    clip: float  # px


class _Sparse(torch.autograd.Function):
    """The same values, whose gradient has the rows of `shown` alone; that is a list which the rendering fills."""

    @staticmethod
    def forward(ctx, values: Tensor, shown: list[Tensor]) -> Tensor:
        ctx.shown = shown
        return values.view_as(values)

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None]:
        rows = torch.cat(ctx.shown).unique()
        return torch.sparse_coo_tensor(rows[None], gradient[rows], gradient.shape, check_invariants=False), None


def _sparse(given: tuple[Tensor | None, ...], shown: list[Tensor], packed: bool) -> Iterator[Tensor | None]:
    if not packed or given[0].dim() != 2:
        raise ValueError("sparse_grad needs packed=True, and no batches")
    return (None if values is None else _Sparse.apply(values, shown) for values in given)


class _Described(NamedTuple):
    """What gsplat tells of the N Gaussians of an image; zeros where they are not shown."""

    radii: Tensor  # (N, 2) int32, px
    means2d: Tensor  # (N, 2) px, pixel centres at halves
    depths: Tensor  # (N,)
    conics: Tensor  # (N, 3): xx, xy, yy of the inverse covariance
    opacities: Tensor  # (N,), of antialiased ones with their factor
    tiles: Tensor  # (N,) int32


class _Drawn(NamedTuple):
    """An image, and what the notes need of it."""

    image: Tensor  # (H, W, D)
    alpha: Tensor  # (H, W, 1)
    found: _Described
    probe: Tensor  # (N, 3), which gets the gradient of the means on the image, in NDC


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

    means (..., N, 3); quats (..., N, 4): w x y z, any length; scales (..., N, 3); or covars (..., N, 3, 3) for both;
    opacities (..., N). colors (..., N, D) or (..., C, N, D); with sh_degree, at most 3, SH (..., N, K, 3) or
    (..., C, N, K, 3). viewmats (..., C, 4, 4): world to view, differentiable. Ks (..., C, 3, 3): no gradient.
    near_plane, far_plane: depths that are shown. radius_clip (px): smaller Gaussians are left out. eps2d (px^2): added
    to variances, 0 to 1. backgrounds (..., C, D), or packed (D,). render_mode: D is the sum of weights times depth, ED
    is D over alpha. sparse_grad: gradients of means, quats and scales are sparse. absgrad: meta["means2d"].absgrad, of
    at most 32 channels; x has the length of x and y in NDC, times 2 / width, and y is 0. Returns images (..., C, H, W,
    D), alphas (..., C, H, W, 1), and meta, whose means2d gets a `grad` (px). ValueError: what cannot be drawn.
    """
    width, height, tile_size, backgrounds = _checked(locals())
    given = means, quats, scales, opacities, covars, colors, viewmats, Ks, backgrounds
    shown: list[Tensor] = []
    given = (*_sparse(given[:3], shown, packed), *given[3:]) if sparse_grad else given
    form = *means.shape[:-2], viewmats.shape[-3] if viewmats.dim() > 2 else 1
    options = _Options(sh_degree, render_mode, rasterize_mode == "antialiased", eps2d, absgrad, radius_clip)
    frame = width, height, camera_model, near_plane, far_plane
    with torch.autocast(means.device.type, enabled=False):  # its products of matrices are of 8 or 11 bits
        images = _images(*given, form[-1], sh_degree is not None)
        drawn = [_render(_Camera(*view, *frame), rows, background, options) for rows, view, background in images]
    meta = _meta(drawn, form, (width, height), tile_size, packed, absgrad)
    shown += [meta["gaussian_ids"]]
    return *(_together([one[at].contiguous() for one in drawn], form) for at in (0, 1)), meta


def _together(parts: Sequence[Tensor], form: tuple[int, ...]) -> Tensor:
    """Tensors of all images as one."""
    return parts[0][None] if form == (1,) else torch.stack(parts).unflatten(0, form)


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
) -> Iterator[tuple[_Rows, tuple[Tensor, Tensor], Tensor | None]]:
    """For each image the Gaussians, the first fields of `_Camera`, and the background. ValueError for wrong inputs."""
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
        shapes |= {"backgrounds": (backgrounds, (cameras, *backgrounds.shape[-1:]))}
    for name, (values, shape) in shapes.items():
        if values is None or values.shape != batch + shape:
            found = None if values is None else tuple(values.shape)
            raise ValueError(f"{name} must be {tuple(batch + shape)}, got {found}")
        if values.dtype != means.dtype and name not in ("Ks", "backgrounds"):
            raise ValueError(f"{name} must be {means.dtype} like means, got {values.dtype}")

    def item(values: Tensor | None, axes: int, at: int) -> Tensor | None:
        if values is None or not batch:
            return values
        return values.reshape(batches, *values.shape[values.dim() - axes :])[at]

    batches = math.prod(batch)
    for at in range(batches):
        rows = [(means, 2), (quats, 2), (scales, 2), (opacities, 1), (covars, 3)]
        own = [item(values, axes, at) for values, axes in rows]
        shown, behind = item(colors, 2 + harmonics + each, at), item(backgrounds, 2, at)
        views, intrinsics = item(viewmats, 3, at), item(Ks.detach().to(means.device), 3, at)
        for n in range(cameras):
            camera = views[n], intrinsics[n]
            yield _Rows(*own, shown[n] if each else shown), camera, None if behind is None else behind[n]


def _checked(given: dict[str, Any]) -> tuple[int, int, int, Tensor | None]:
    """Width, height, tile_size and backgrounds of the arguments of `rasterization`. ValueError for wrong arguments."""
    for name, remedy in _UNSUPPORTED.items():
        if isinstance(given[name], Tensor) or given[name]:
            raise ValueError(f"{name} is not supported; {remedy}")
    shutter, degree, eps2d = given["rolling_shutter"], given["sh_degree"], given["eps2d"]
    check_tensors({name: given[name] for name in (*_NEEDED, *_OTHERS)})
    for name, shape in _NEEDED.items():
        if (found := given[name]) is None or found.dim() < 2:
            raise ValueError(f"{name} must be {shape}, got {None if found is None else tuple(found.shape)}")
    if shutter is not None and getattr(shutter, "name", "GLOBAL") != "GLOBAL":
        raise ValueError("rolling_shutter is not supported; take poses of a global shutter")
    for name, choices in _CHOICES.items():
        if given[name] not in choices:
            raise ValueError(f"{name} must be one of {', '.join(choices)}, got {given[name]!r}")
    if not 0 <= eps2d <= 1:
        raise ValueError(f"eps2d must be 0 to 1 px^2, got {eps2d}")
    if degree is not None and whole_number("sh_degree", degree, 0) > MOST_DEGREE:
        raise ValueError(f"sh_degree must be 0 to {MOST_DEGREE}, got {degree}")
    behind = given["backgrounds"]
    if given["packed"] and behind is not None and behind.dim() == 1:  # gsplat's rows that are packed have no cameras
        behind = behind.expand(*given["means"].shape[:-2], *given["viewmats"].shape[-3:-2], -1)
    return *(whole_number(name, given[name]) for name in ("width", "height", "tile_size")), behind


def _render(camera: _Camera, rows: _Rows, background: Tensor | None, options: _Options) -> _Drawn:
    gaussians, features, depth = _shapes(rows, options), [], None
    cuts = camera.model != "pinhole" or camera.far < _ENDLESS  # the kernels know the near plane of a pinhole alone
    with_depth = options.mode.endswith("D")
    if cuts or with_depth:
        depth = rows.means @ camera.view[2, :3] + camera.view[2, 3]
    if options.mode.startswith("RGB") and options.degree is None:
        features.append(rows.colors)
    if with_depth:
        features.append(depth[:, None])
    behind = rows.means.new_zeros(1)  # also of depth
    if background is not None and options.mode.startswith("RGB"):
        behind = torch.nn.functional.pad(background, (0, 1)) if with_depth else background
    opacities = rows.opacities
    if cuts:
        opacities = torch.where((depth > camera.near) & (depth < camera.far), opacities, 0)
    wanted = any(values is not None and values.requires_grad for values in (*rows, camera.view, background))
    probe = torch.empty_like(rows.means).requires_grad_(wanted and torch.is_grad_enabled())
    settings = camera.settings(options.degree, options.antialiased, options.dilation, behind)
    out = rasterize_channels(
        rows.means,
        probe,
        opacities,
        settings,
        features=(features[0] if len(features) == 1 else torch.cat(features, 1)) if features else None,
        depths=depth.detach() if cuts else None,
        any_rotation=True,
        want_absolute_gradient=options.absgrad,
        most_alpha=_MOST_ALPHA,
        **gaussians,
    )
    depths = depth.detach() if cuts else out.depths
    found = _Described(*OPERATORS.describe(out.splats, depths, out.tile_counts), out.tile_counts)
    if options.clip > 0:
        small = (found.radii > 0).all(1) & (found.radii <= options.clip).all(1)
        if small.any():
            rest = rows._replace(opacities=torch.where(small, 0, rows.opacities))
            return _render(camera, rest, background, options._replace(clip=0.0))
    image, alpha = out.image.permute(1, 2, 0), (1 - out.transmittance).view(camera.height, camera.width, 1)
    if options.mode.endswith("ED"):
        image = torch.cat([image[..., :-1], image[..., -1:] / alpha.clamp_min(1e-10)], -1)
    return _Drawn(image, alpha, found, probe)


def _shapes(rows: _Rows, options: _Options) -> dict[str, Tensor]:
    """Shapes and SH, by the names of `Gaussians`."""
    if rows.covars is None:
        shape = {"scales": rows.scales, "rotations": rows.quats}
    else:
        places = (0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)
        shape = {"cov3d": torch.stack([rows.covars[:, i, j] for i, j in places], 1)}
    if options.mode.startswith("RGB") and options.degree is not None:
        harmonics = rows.colors if rows.colors.shape[1] <= MOST_BANDS else rows.colors[:, :MOST_BANDS]
        shape["sh_dc"], shape["sh_rest"] = harmonics.split((1, harmonics.shape[1] - 1), 1)
    return shape


def _meta(
    drawn: Sequence[_Drawn], form: tuple[int, ...], size: tuple[int, int], tile: int, packed: bool, absgrad: bool
) -> dict[str, Any]:
    """The notes, in which means2d gets `grad`, and `absgrad`, when the gradients of its parts are known."""
    ids = dict.fromkeys(("batch_ids", "camera_ids", "gaussian_ids"))
    rows = None
    if packed:
        rows = [(one.found.radii > 0).all(1).nonzero()[:, 0] for one in drawn]
        image = torch.cat([torch.full_like(own, n) for n, own in enumerate(rows)])
        ids = {"batch_ids": image // form[-1], "camera_ids": image % form[-1], "gaussian_ids": torch.cat(rows)}
        parts = zip(*([part[own] for part in one.found] for one, own in zip(drawn, rows, strict=True)), strict=True)
        values = _Described(*(part[0] if len(part) == 1 else torch.cat(part) for part in parts))
    else:
        values = _Described(*(_together(part, form) for part in zip(*(d.found for d in drawn), strict=True)))
    means2d = values.means2d.requires_grad_(drawn[0].probe.requires_grad)
    begin = 0
    for n, one in enumerate(drawn) if means2d.requires_grad else ():
        place = n if rows is None else slice(begin, begin := begin + len(rows[n]))
        one.probe.register_hook(_collector(means2d, place, rows and rows[n], absgrad, size))
    notes = {"radii": values.radii, "means2d": means2d, "depths": values.depths, "conics": values.conics}
    notes |= {"opacities": values.opacities, "tiles_per_gauss": values.tiles}
    (width, height), across, down = size, *(-(-pixels // tile) for pixels in size)
    sizes = {"width": width, "height": height, "tile_size": tile, "tile_width": across, "tile_height": down}
    return ids | notes | sizes | {"n_batches": math.prod(form[:-1]), "n_cameras": form[-1]}


def _collector(
    means2d: Tensor, place: int | slice, rows: Tensor | None, absgrad: bool, size: tuple[int, int]
) -> Callable[[Tensor], None]:
    """What puts the gradients of an image's means, which are per NDC unit, into `means2d`; of packed ones, its rows."""

    def collect(gradient: Tensor) -> None:
        if rows is not None:
            gradient = gradient[rows]
        for name, first in (("grad", 0), ("absgrad", 2))[: 1 + absgrad]:
            if getattr(means2d, name, None) is None:
                setattr(means2d, name, torch.zeros_like(means2d))
            into = getattr(means2d, name)
            own = into[place] if rows is not None else into.flatten(0, -3)[place]
            for axis in range(2 if first == 0 else 1):
                own[:, axis].add_(gradient[:, first + axis], alpha=2 / size[axis])

    return collect


if __name__ == "__main__":
    from diff_gaussian_rasterization.gsplat_programs import run

    run()
