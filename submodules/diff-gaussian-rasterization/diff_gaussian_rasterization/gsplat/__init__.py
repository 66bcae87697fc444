"""gsplat's function `rasterization`, in the form of its version 1.6, on this rasterizer: CPU and CUDA.

    from diff_gaussian_rasterization.gsplat import rasterization
    python -m diff_gaussian_rasterization.gsplat PROGRAM.py [OPTION...]    # runs a program whose gsplat is this one

Names, order, defaults, shapes and results are gsplat's; what it does not have is refused by name.
"""

import contextlib
import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.weak import TensorWeakRef

import diff_gaussian_rasterization.gsplat.fakes  # noqa: F401  (registers the fake kernels)
from diff_gaussian_rasterization.alternatives import MOST_BANDS, MOST_DEGREE
from diff_gaussian_rasterization.backend import OPERATORS
from diff_gaussian_rasterization.channels import MOST_CHANNELS
from diff_gaussian_rasterization.first_order import needs_function
from diff_gaussian_rasterization.gsplat.description import described
from diff_gaussian_rasterization.gsplat.inputs import Call, Item, check_call, split_images
from diff_gaussian_rasterization.gsplat.meta import Meta
from diff_gaussian_rasterization.harmonics import sh_values
from diff_gaussian_rasterization.lens import Lens
from diff_gaussian_rasterization.stages import Blending, Shared, blended, projected

_ENDLESS = 1e10  # far_plane, if nobody gives one
_MOST_ALPHA = 0.999
_FLAT = 2.0**-40  # of depth
_NO_CONTEXT = contextlib.nullcontext()
_NUMBERS = {False: 10, True: 19}  # of a camera beyond its pose (camera.py), of a pinhole and of a lens


class _Fisheye(Lens):
    """An equidistant lens that shows Gaussians whose centres are up to 90 degrees off the axis, as gsplat does."""

    def numbers(self, width: int, height: int) -> tuple[float, ...]:
        chart, _, reach, _, *rest = super().numbers(width, height)
        return chart, (math.pi / 2) ** 2, reach, math.pi / 2, *rest


class _Projection(NamedTuple):
    """The splats of an image, and what they show."""

    shared: Shared
    splats: Tensor
    colored: bool  # whether they have colours
    features: Tensor | None  # (N, F): colours that they do not have, then signals
    train: bool  # whether a backward may follow
    order: Tensor  # (N,) depths
    lists: list[Tensor]  # of tiles, or what they are made of
    tile_counts: Tensor
    notes: tuple[Tensor, ...]  # of `described`, without the rows
    rows: Tensor | None  # that are shown, if they are packed


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


def rasterization(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Tensor | None,
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
    tile_size: int | None = None,
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
    return_normals: bool = False,
    global_z_order: bool = True,
    rays: Tensor | None = None,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any = None,
    lidar_coeffs: Any = None,
    external_distortion_coeffs: Any = None,
    rolling_shutter: Any = None,
    viewmats_rs: Tensor | None = None,
    ut_params: Any = None,
    extra_signals: Tensor | None = None,
    extra_signals_sh_degree: int | None = None,
    renderer_config: Any = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Renders N Gaussians with C cameras, and leading batch dimensions, as gsplat 1.6 does.

    means (..., N, 3); quats (..., N, 4): w x y z, any length; scales (..., N, 3); or covars (..., N, 3, 3) for both;
    opacities (..., N). colors, extra_signals (..., N, D) or (..., C, N, D), or with a degree SH (N, K, D), perhaps of
    each batch or camera. viewmats (..., C, 4, 4): world to view, differentiable. Ks (..., C, 3, 3): no gradient.
    radius_clip (px): smaller Gaussians are left out. eps2d (px^2): added to variances, 0 to 1. backgrounds (..., C, D),
    or packed (D,). render_mode: D is the sum of weights times depth, ED is D over alpha. global_z_order: depths are
    along the axis, else distances. sparse_grad: gradients of means, quats and scales are sparse. absgrad:
    meta["means2d"].absgrad, of at most 32 channels; x has the length of x and y in NDC, times 2 / width, and y is 0.
    Returns images (..., C, H, W, D), alphas (..., C, H, W, 1), and meta. ValueError: what cannot be drawn.
    """
    call, backgrounds, tile = check_call(locals())
    given = Item(means, quats, scales, covars, opacities, colors, extra_signals, viewmats, Ks, backgrounds)
    with _without_autocast(means.device.type):  # whose products of matrices are of 8 or 11 bits
        return _render_all(call, given, tile, sparse_grad)


def _without_autocast(device: str) -> contextlib.AbstractContextManager:
    return torch.autocast(device, enabled=False) if torch.is_autocast_enabled(device) else _NO_CONTEXT


def _render_all(call: Call, given: Item, tile: int, sparse: bool) -> tuple[Tensor, Tensor, Meta]:
    """Render all images of a call. Return images, alphas and meta, as `rasterization` does.

    given: tensors of all images.
    tile: side of the tiles that meta tells of, px.
    sparse: true if gradients of means, quats and scales are sparse.
    """
    shown: list[Tensor] = []
    if sparse:
        if not call.packed or given.means.dim() != 2:
            raise ValueError("sparse_grad needs packed=True, and no batches")
        rows = {name: getattr(given, name) for name in ("means", "quats", "scales")}
        given = given._replace(**{name: None if t is None else _Sparse.apply(t, shown) for name, t in rows.items()})
    form = *given.means.shape[:-2], given.view.shape[-3] if given.view.dim() > 2 else 1
    items = split_images(call, given, form)
    projections = [_project(call, item) for item in items]
    notes, pieces = _join_notes(call, [one.notes for one in projections], form)
    drawn = [_blend(call, *one) for one in zip(items, projections, pieces, strict=True)]
    lists = [(*one[3], projection.order) for one, projection in zip(drawn, projections, strict=True)]
    meta = _make_meta(call, notes, lists, projections, form, tile)
    if given.signals is not None:
        meta["render_extra_signals"] = _stack_images([one[2] for one in drawn], form)
    shown += [meta["gaussian_ids"]] * sparse
    image, alpha = (_stack_images([one[at] for one in drawn], form) for at in (0, 1))
    return image, alpha, meta


def _stack_images(parts: Sequence[Tensor], form: tuple[int, ...]) -> Tensor:
    """Tensors (1, ...) of all images as one."""
    whole = parts[0] if len(parts) == 1 else torch.cat(tuple(parts))
    return whole if len(form) == 1 else whole.unflatten(0, form)


def _project(call: Call, item: Item) -> _Projection:
    """Project the Gaussians of one image, and describe them as programs of gsplat know them."""
    view, near = item.view, call.near
    camera = OPERATORS.pinhole(view.detach(), item.K, *call.size)
    if call.model == "ortho":  # a pinhole for which all is at the same depth, up to rounding, but for its centre
        view, near = torch.cat([view[:2], _FLAT * view[2:3] + view.new_tensor([[0, 0, 0, 1]]), view[3:]]), 0.0
        camera = *OPERATORS.pinhole(view.detach(), item.K, *call.size)[:2], camera[2]
    lens = _lens_numbers(call, item.K)
    opacities, depth = item.opacities, _find_depths(call, item)
    if call.model != "pinhole" or call.far < _ENDLESS:  # the kernels know the near plane of a pinhole alone
        z = item.means.detach() @ item.view.detach()[2, :3] + item.view.detach()[2, 3]
        opacities = torch.where((z > call.near) & (z < call.far), opacities, 0)
    colors, harmonics, degree, features = item.colors, (None, None), None, []
    if colors is not None and call.degree is not None and call.degree <= MOST_DEGREE and colors.shape[-1] == 3:
        bands = colors if colors.shape[1] <= MOST_BANDS else colors[:, :MOST_BANDS]
        degree, harmonics = call.degree, bands.split((1, bands.shape[1] - 1), 1)
    elif colors is not None:
        features.append(_evaluate_features(item, colors, call.degree, 0.0))
    if item.signals is not None:
        features.append(_evaluate_features(item, item.signals, call.signal_degree, -math.inf))
    scene = (
        item.means, opacities, item.scales, item.quats, item.covars,
        item.means.detach() if degree is None else None,  # projection asks for colours; nothing shows these
        *harmonics, *camera, (*lens, call.eps2d, near), (*call.size, degree or 0, 2 * call.antialiased, 2),
    )  # fmt: skip
    numbers = _camera_numbers(view, item.view if degree else None, len(lens) > 3) if needs_function(view) else None
    shared = Shared()
    train = needs_function(*item)
    how = shared, train if depth is None else None, numbers, None
    splats, own, counts, _, *lists = projected(*how, *scene)
    if call.clip > 0:
        radii = OPERATORS.describe(splats.detach(), own.detach(), counts, *call.size)[0]
        opacities = torch.where((radii <= call.clip).all(1), 0, opacities)
        splats, own, counts, _, *lists = projected(*how, item.means, opacities, *scene[2:])
    depth = own if depth is None else depth
    *notes, rows = described(shared, call.size, call.packed, splats, depth, counts)
    shown = torch.cat(features, 1) if len(features) > 1 else features[0] if features else None
    colored, order = degree is not None, depth.detach()
    return _Projection(shared, splats, colored, shown, train, order, lists, counts, tuple(notes), rows)


def _lens_numbers(call: Call, K: Tensor) -> tuple[float, ...]:
    """The first numbers of Scene.lens. Of a pinhole no number goes to the host, which would wait for it."""
    if call.model == "pinhole":
        return 0.0, 0.0, 1.0
    fx, _, cx, _, fy, cy, *_ = K.flatten().tolist()
    height, width = call.size
    fisheye = call.model == "fisheye"
    lens = (_Fisheye if fisheye else Lens)("equidistant" if fisheye else "perspective", (fx, fy), (cx - 0.5, cy - 0.5))
    return 0.0, 0.0, 1.0, *lens.numbers(width, height)


def _camera_numbers(view: Tensor, seen_from: Tensor | None, lens: bool) -> Tensor:
    """The camera's numbers (camera.py), of which only the gradients of the pose are read: 15, then zeros.

    seen_from (4, 4): the pose whose centre colours depend on.
    """
    view = view.double()
    center = view.new_zeros(3) if seen_from is None else _camera_center(seen_from)
    return torch.cat([view[:3, :3].reshape(9), view[:3, 3], center, view.new_zeros(_NUMBERS[lens])])


def _find_depths(call: Call, item: Item) -> Tensor | None:
    """Depths (N,) where they are not those that the kernels find."""
    if not call.by_z:
        return torch.linalg.vector_norm(item.means @ item.view[:3, :3].T + item.view[:3, 3], dim=1)
    return None if call.model == "pinhole" else item.means @ item.view[2, :3] + item.view[2, 3]


def _evaluate_features(item: Item, values: Tensor, degree: int | None, least: float) -> Tensor:
    """Values (N, D), or what SH (N, K, D) are in the directions from the camera, at least `least`."""
    if degree is None:
        return values
    return (sh_values(degree, values, item.means - _camera_center(item.view).to(item.means)) + 0.5).clamp_min(least)


def _camera_center(view: Tensor) -> Tensor:
    """The place of a camera (3,), float64, by its view (4, 4)."""
    return torch.linalg.inv_ex(view.double())[0][:3, 3]


@cache
def _make_black(device: torch.device, dtype: torch.dtype) -> Tensor:
    with torch.inference_mode(False):  # so that training can use it after a render in inference mode
        return torch.zeros(1, device=device, dtype=dtype)


def _join_notes(
    call: Call, notes: Sequence[tuple[Tensor, ...]], form: tuple[int, ...]
) -> tuple[list[Tensor], list[tuple[Tensor, ...]]]:
    """The notes of all images, and of each image what these are made of, so that images are made of the notes."""
    if len(notes) == len(form) == 1:
        return list(notes[0]), [notes[0]]
    whole = [torch.cat(part) for part in zip(*notes, strict=True)]
    if not call.packed:
        whole = [part.unflatten(0, form) for part in whole]
    sizes = [len(one[0]) for one in notes]
    flat = whole if call.packed else [part.flatten(0, len(form) - 1) for part in whole]
    return whole, list(zip(*(part.split(sizes) for part in flat), strict=True))


def _blend(
    call: Call, item: Item, of: _Projection, notes: tuple[Tensor, ...]
) -> tuple[Tensor, Tensor, Tensor | None, list[Tensor]]:
    """Image (1, H, W, D), alpha (1, H, W, 1), signals (1, H, W, E), and the lists of tiles."""
    width = 0 if item.colors is None else item.colors.shape[-1]
    signals = 0 if item.signals is None else item.signals.shape[-1]
    further, behind = signals + call.deep, item.background if call.colored else None
    if call.absgrad and width + further > MOST_CHANNELS:
        raise ValueError(f"absgrad needs at most {MOST_CHANNELS} channels, got {width + further}")
    if behind is None:
        behind = _make_black(item.means.device, item.means.dtype)
    else:
        behind = behind.to(item.means)
        behind = torch.nn.functional.pad(behind, (0, further)) if further else behind
    _, means2d, depths, conics, opacities, _ = notes
    image, alpha, *lists = blended(
        of.shared,
        Blending(call.size, _MOST_ALPHA, True, of.colored, call.absgrad, True),
        of.train,
        *(of.order, of.lists, of.tile_counts, of.rows, of.splats),
        *(means2d, conics, opacities, depths if call.deep else None, of.features, behind),
    )
    if call.mean_depth:
        image = torch.cat([image[..., :-1], image[..., -1:] / alpha.clamp_min(1e-10)], -1)
    if not signals:
        return image, alpha, None, lists
    end = width + signals  # behind the signals are the depths
    return torch.cat([image[..., :width], image[..., end:]], -1), alpha, image[..., width:end], lists


def _make_meta(
    call: Call,
    notes: list[Tensor],
    lists: Sequence[tuple[Tensor, ...]],
    projections: Sequence[_Projection],
    form: tuple[int, ...],
    tile: int,
) -> Meta:
    """The notes as gsplat names them; means2d gets `absgrad` in a backward."""
    rows = [one.rows for one in projections]
    ids: dict[str, Any] = dict.fromkeys(("batch_ids", "camera_ids", "gaussian_ids"))
    if call.packed:
        if form == (1,):
            ids = dict.fromkeys(ids, torch.zeros_like(rows[0])) | {"gaussian_ids": rows[0]}
        else:
            image = torch.cat([torch.full_like(own, n) for n, own in enumerate(rows)])
            ids = {"batch_ids": image // form[-1], "camera_ids": image % form[-1], "gaussian_ids": torch.cat(rows)}
    hooks = [_hooks_of(notes[n]) for n in (1, 3, 4) if notes[n].requires_grad]
    for one in projections:
        one.shared.hooks = hooks
    begin = 0
    for n, one in enumerate(projections) if call.absgrad else ():
        place = slice(begin, begin := begin + len(one.rows)) if call.packed else n
        one.shared.use_lengths = _Lengths(TensorWeakRef(notes[1]), place, one.rows, call.size[1])
    names = "radii", "means2d", "depths", "conics", "opacities", "tiles_per_gauss"
    (height, width), tiles = call.size, [-(-pixels // tile) for pixels in call.size]
    sizes = {"width": width, "height": height, "tile_size": tile, "tile_width": tiles[1], "tile_height": tiles[0]}
    sizes |= {"n_batches": math.prod(form[:-1]), "n_cameras": form[-1]}
    return Meta(ids | dict(zip(names, notes, strict=True)) | sizes, form, lists, rows)


def _hooks_of(values: Tensor) -> Callable[[], dict | None]:
    """A weak reference to the hooks of values, which gets those that are registered later."""
    handle = values.register_hook(torch.neg)
    handle.remove()
    return handle.hooks_dict_ref


class _Lengths(NamedTuple):
    """Writes the lengths of one image's absolute gradients into `absgrad` of means2d, for programs of gsplat.

    means2d: weak reference to the tensor (..., C, N, 2), or (rows, 2) if it is packed.
    place: index of the image among all images; if packed, the slice of its rows.
    rows: Gaussians of these rows, int64; None if not packed.
    width: width of the image, px.
    """

    means2d: TensorWeakRef
    place: int | slice
    rows: Tensor | None
    width: int

    def __call__(self, lengths: Tensor) -> None:
        """Write lengths (N,), per NDC unit, into column 0 of `absgrad`, which begins as zeros.

        Programs of gsplat multiply the columns by half the width and half the height, and take the norm of both. Column
        0 has the length times 2 / width, and column 1 stays 0, so that the norm is the length.
        """
        if (means2d := self.means2d()) is None:
            return
        if getattr(means2d, "absgrad", None) is None:
            means2d.absgrad = torch.zeros_like(means2d)
        into = means2d.absgrad.flatten(0, -3)[self.place] if self.rows is None else means2d.absgrad[self.place]
        into[:, 0] = (lengths if self.rows is None else lengths[self.rows]) * (2 / self.width)
