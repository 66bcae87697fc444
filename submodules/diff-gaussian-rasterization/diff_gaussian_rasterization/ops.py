"""The operators of csrc/ops.cpp as Python sees them: checks with readable messages, fake kernels, autograd.

Letters: N Gaussians, K spherical harmonics, H x W pixels, I instances (a splat in a tile), tiles of 16 x 16.
"""

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor, library
from torch.autograd.function import once_differentiable

if TYPE_CHECKING:
    from diff_gaussian_rasterization import GaussianRasterizationSettings

_LIBRARY = Path(__file__).with_name("_backend.so")
try:
    torch.ops.load_library(_LIBRARY)
except OSError as error:
    what = f"does not fit torch {torch.__version__}" if _LIBRARY.exists() else "is not built"
    remedy = "run `pip install ./submodules/diff-gaussian-rasterization` in the repository"
    raise ImportError(f"diff_gaussian_rasterization {what}: {remedy}") from error

_ops = torch.ops.diff_gaussian_rasterization

# Inputs that receive gradients, in the order of `wanted` and of the results of rasterize_vjp.
GRADIENTS = ("means", "means2d", "opacities", "scales", "rotations", "cov3d", "colors", "sh_dc", "sh_rest")
_SCENE = ("means", "opacities", "scales", "rotations", "cov3d", "colors", "sh_dc", "sh_rest")
_SCENE += ("view", "projection", "center")
_TENSORS = len(_SCENE)  # what comes before is a tensor or None, what comes after a number
_SCENE += ("tan_x", "tan_y", "height", "width", "sh_degree", "scale_modifier", "antialiasing", "raw")
_INPUTS = ("means2d", *_SCENE)
_PLACES = tuple(_INPUTS.index(name) for name in GRADIENTS)  # the first nine, means2d and means swapped
_OTHER_INPUTS = (None,) * (len(_INPUTS) - len(GRADIENTS) + 3)  # background, inverse_depth and train come last
_ROWS = {"means": (3,), "means2d": (3,), "opacities": (1,), "scales": (3,), "rotations": (4,), "cov3d": (6,)}
_ROWS |= {"colors": (3,), "sh_dc": (1, 3)}
_TILE = 16
_VALUES = 10  # of a row of `splats` and of `moments`


class Rasterized(NamedTuple):
    """What `rasterize` returns."""

    color: Tensor  # (3, H, W), background included
    radii: Tensor  # (N,) int32, px: ceil of 3 sigma, 0 where culled
    inverse_depth: Tensor | None  # (1, H, W): sum of alpha T / z, no background, not normalised
    transmittance: Tensor | None  # (1, H, W): what is left for the background


def rasterize(
    means: Tensor,
    means2d: Tensor,
    opacities: Tensor,
    settings: "GaussianRasterizationSettings",
    *,
    scales: Tensor | None = None,
    rotations: Tensor | None = None,
    cov3d: Tensor | None = None,
    sh_dc: Tensor | None = None,
    sh_rest: Tensor | None = None,
    colors: Tensor | None = None,
    raw: bool = False,
    want_inverse_depth: bool = False,
    want_transmittance: bool = False,
) -> Rasterized:
    """Renders Gaussians (Kerbl et al. 2023, section 4 and 6); differentiable in every tensor but the settings'.

    means (N, 3) world; means2d (N, 3): only receives d loss / d mean per NDC unit; opacities (N, 1); scales (N, 3)
    and rotations (N, 4) w x y z, or cov3d (N, 6) as xx xy xz yy yz zz; sh_dc (N, 1, 3) and sh_rest (N, K-1, 3), of
    which the bands up to settings.sh_degree are read, or colors (N, 3). All float32 or all float64.
    raw: opacities are logits, scales logarithms, rotations of any length (zero counts as the identity); otherwise all
    are taken as given. Gaussians with a NaN or Inf are left out and receive zero gradients.
    Raises TypeError and ValueError for wrong dtypes and shapes, RuntimeError where the image needs more than 2^31
    tile instances.
    """
    tensors = {"means": means, "opacities": opacities, "scales": scales, "rotations": rotations, "cov3d": cov3d}
    tensors |= {"colors": colors, "sh_dc": sh_dc, "sh_rest": sh_rest}
    _check(tensors, means2d, settings.sh_degree, raw)
    differentiable = [t for t in (*tensors.values(), means2d) if t is not None]
    train = torch.is_grad_enabled() and any(t.requires_grad for t in differentiable)
    if settings.debug:
        for name, t in tensors.items():
            if t is not None:
                _check_finite(name, t)
    scene = _arguments(tensors, settings, raw)
    out = (_Rasterize.apply if train else _ops.rasterize)(means2d, *scene, settings.bg, want_inverse_depth, train)
    color, transmittance, inverse_depth, radii = out[:4]
    if settings.debug:
        _check_finite("the rendered image", color)
        if train:
            for name, t in [*tensors.items(), ("means2d", means2d)]:
                if t is not None and t.requires_grad:
                    t.register_hook(lambda g, name=name: _check_finite(f"the gradient of {name}", g))
    return Rasterized(
        color, radii, inverse_depth if want_inverse_depth else None, transmittance if want_transmittance else None
    )


@torch.no_grad()
def decisive(
    means: Tensor,
    opacities: Tensor,
    settings: "GaussianRasterizationSettings",
    *,
    scales: Tensor | None = None,
    rotations: Tensor | None = None,
    cov3d: Tensor | None = None,
    sh_dc: Tensor | None = None,
    sh_rest: Tensor | None = None,
    colors: Tensor | None = None,
    raw: bool = False,
) -> Tensor:
    """(N,) bool: the Gaussians that the image, as `rasterize` gives it for these arguments, depends on.

    They are blended in a pixel or end one: where a Gaussian would leave less than 1e-4 of the transmittance, the pixel
    takes neither it nor any behind it. Without the others the image is the same, bit for bit.
    """
    tensors = {"means": means, "opacities": opacities, "scales": scales, "rotations": rotations, "cov3d": cov3d}
    tensors |= {"colors": colors, "sh_dc": sh_dc, "sh_rest": sh_rest}
    _check(tensors, means, settings.sh_degree, raw)
    out = _ops.rasterize(means, *_arguments(tensors, settings, raw), settings.bg, False, True)
    _, _, _, _, splats, _, instances, ranges, _, _, last = out
    return _ops.decisive(splats, instances, ranges, last)


def _arguments(tensors: dict[str, Tensor | None], settings: "GaussianRasterizationSettings", raw: bool) -> tuple:
    """What the operators take of Gaussians and camera, in the order of _SCENE."""
    return (
        *tensors.values(),
        settings.viewmatrix,
        settings.projmatrix,
        settings.campos,
        settings.tanfovx,
        settings.tanfovy,
        settings.image_height,
        settings.image_width,
        settings.sh_degree,
        settings.scale_modifier,
        settings.antialiasing,
        raw,
    )


def mark_visible(positions: Tensor, view: Tensor) -> Tensor:
    """(N,) bool: z above 0.2 of positions (N, 3) in the view (4, 4, transposed)."""
    return _ops.mark_visible(positions, view)


def _check(tensors: dict[str, Tensor | None], means2d: Tensor, sh_degree: int, raw: bool) -> None:
    means = tensors["means"]
    if means.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"means must be float32 or float64, got {means.dtype}")
    if means.dim() != 2 or means.shape[1] != 3:
        raise ValueError(f"means must be (N, 3), got {tuple(means.shape)}")
    if (tensors["cov3d"] is None) == (tensors["scales"] is None or tensors["rotations"] is None):
        raise ValueError("give scales and rotations, or cov3d")
    if (tensors["colors"] is None) == (tensors["sh_dc"] is None or tensors["sh_rest"] is None):
        raise ValueError("give sh_dc and sh_rest, or colors")
    dtype, device, n = means.dtype, means.device, means.shape[0]
    for name, t in (*tensors.items(), ("means2d", means2d)):
        if t is None:
            continue
        if t.dtype is not dtype or t.device != device:
            raise TypeError(f"{name} must be {dtype} on {device} like means, got {t.dtype} on {t.device}")
        shape = t.shape
        row = _ROWS.get(name) or tuple(shape[1:])
        if shape != (n, *row) and not (name == "opacities" and shape == (n,)):
            hints = {"scales": "logarithms of the scales" if raw else "activated scales, one per axis"}
            hint = f" ({hints[name]})" if name in hints else ""
            raise ValueError(f"{name} must be {(n, *row)}{hint}, got {tuple(shape)}")
    if not 0 <= sh_degree <= 3:
        raise ValueError(f"sh_degree must be 0 to 3, got {sh_degree}")
    rest = tensors["sh_rest"]
    if rest is not None and (rest.dim() != 3 or rest.shape[2] != 3 or rest.shape[1] < (sh_degree + 1) ** 2 - 1):
        needed = (sh_degree + 1) ** 2 - 1
        raise ValueError(
            f"sh_rest must be ({n}, {needed} or more, 3) for sh_degree {sh_degree}, got {tuple(rest.shape)}"
        )


def _check_finite(what: str, t: Tensor) -> None:
    bad = ~torch.isfinite(t)
    if bad.any():
        raise FloatingPointError(
            f"{what} has {int(bad.sum())} values that are not finite, the first at {bad.nonzero()[0].tolist()}"
        )


def _scene(args: tuple) -> dict:
    return dict(zip(_SCENE, args, strict=True))


def _tiles(height: int, width: int) -> int:
    return -(-height // _TILE) * -(-width // _TILE)


def _fake_gradients(scene: dict, wanted: list[bool]) -> tuple[Tensor, ...]:
    means, n = scene["means"], scene["means"].shape[0]
    bands = 0 if scene["sh_rest"] is None else scene["sh_rest"].shape[1]
    tails = [(3,), (3,), (1,), (3,), (4,), (6,), (3,), (1, 3), (bands, 3)]
    return tuple(means.new_empty((n if w else 0, *tail)) for w, tail in zip(wanted, tails, strict=True))


@library.register_fake("diff_gaussian_rasterization::project")
def _(*args):
    means = args[0]
    n = means.shape[0]
    ints = [means.new_empty(shape, dtype=torch.int32) for shape in ((n, 4), (n,), (n,))]
    return means.new_empty((n, _VALUES)), means.new_empty((n,)), *ints


def _fake_bin(like: Tensor, n: int, height: int, width: int, train: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    total = library.get_ctx().new_dynamic_size()
    slots = library.get_ctx().new_dynamic_size() if train else 0
    return (
        like.new_empty((total,), dtype=torch.int32),
        like.new_empty((_tiles(height, width) + 1,), dtype=torch.int64),
        like.new_empty((n + 1 if train else 0, 2), dtype=torch.int64),
        like.new_empty((slots, 0), dtype=torch.int32),
    )


@library.register_fake("diff_gaussian_rasterization::bin")
def _(splats, depths, rects, tile_counts, height, width, train):
    return _fake_bin(splats, splats.shape[0], height, width, train)


def _fake_blend(like: Tensor, height: int, width: int, inverse_depth: bool, train: bool) -> tuple[Tensor, ...]:
    return (
        like.new_empty((3, height, width)),
        like.new_empty((1, height, width)),
        like.new_empty((1 if inverse_depth else 0, height, width)),
        like.new_empty((height if train else 0, width), dtype=torch.int32),
    )


@library.register_fake("diff_gaussian_rasterization::blend")
def _(splats, instances, ranges, background, height, width, inverse_depth, train):
    return _fake_blend(splats, height, width, inverse_depth, train)


@library.register_fake("diff_gaussian_rasterization::blend_vjp")
def _(splats, *args):
    return splats.new_empty((splats.shape[0], _VALUES))


@library.register_fake("diff_gaussian_rasterization::project_vjp")
def _(*args):
    return _fake_gradients(_scene(args[: len(_SCENE)]), args[-1])


@library.register_fake("diff_gaussian_rasterization::rasterize_vjp")
def _(*args):
    return _fake_gradients(_scene(args[: len(_SCENE)]), args[-1])


@library.register_fake("diff_gaussian_rasterization::rasterize")
def _(means2d, *args):
    scene = _scene(args[: len(_SCENE)])
    inverse_depth, train = args[-2:]
    means, height, width = scene["means"], scene["height"], scene["width"]
    n = means.shape[0]
    color, transmittance, depth, last = _fake_blend(means, height, width, inverse_depth, train)
    radii, tile_counts = (means.new_empty((n,), dtype=torch.int32) for _ in range(2))
    projected = radii, means.new_empty((n, _VALUES)), tile_counts
    return color, transmittance, depth, *projected, *_fake_bin(means, n, height, width, train), last


@library.register_fake("diff_gaussian_rasterization::mark_visible")
def _(means, view):
    return means.new_empty((means.shape[0],), dtype=torch.bool)


@library.register_fake("diff_gaussian_rasterization::decisive")
def _(splats, *args):
    return splats.new_empty((splats.shape[0],), dtype=torch.bool)


@library.register_fake("diff_gaussian_rasterization::adam_")
@library.register_fake("diff_gaussian_rasterization::sparse_adam_")
@library.register_fake("diff_gaussian_rasterization::observe_")
def _(*args, **kwargs):
    return None


def _setup_context(ctx, inputs, output):
    _, *scene, background, inverse_depth, train = inputs
    _, transmittance, _, _, splats, tile_counts, instances, ranges, splat_slots, slots, last = output
    ctx.mark_non_differentiable(*output[3:])
    ctx.set_materialize_grads(False)
    ctx.numbers, ctx.inverse_depth, ctx.train = scene[_TENSORS:], inverse_depth, train
    state = (splats, instances, ranges, splat_slots, slots, background, last, transmittance)
    ctx.save_for_backward(*scene[:_TENSORS], *state, tile_counts)


def _backward(ctx, grad_color, grad_transmittance, grad_inverse_depth, *_):
    if not ctx.train:
        raise RuntimeError("this image was rasterized with train=False, so it has no backward")
    saved = ctx.saved_tensors
    scene, state, tile_counts = (*saved[:_TENSORS], *ctx.numbers), saved[_TENSORS:-1], saved[-1]
    wanted = [ctx.needs_input_grad[place] for place in _PLACES]
    if grad_color is None:
        grad_color = state[-1].new_zeros(3, *state[-1].shape[1:])
    if not ctx.inverse_depth:
        grad_inverse_depth = None
    image = grad_color, grad_transmittance, grad_inverse_depth
    gradients = _ops.rasterize_vjp(*scene, *state, *image, tile_counts, wanted)
    means, means2d, opacities, *others = (g if w else None for g, w in zip(gradients, wanted, strict=True))
    if opacities is not None and opacities.shape != scene[1].shape:
        opacities = opacities.reshape(scene[1].shape)
    return means2d, means, opacities, *others, *_OTHER_INPUTS


# For whoever calls the op itself, or compiles it.
library.register_autograd("diff_gaussian_rasterization::rasterize", _backward, setup_context=_setup_context)


class _Rasterize(torch.autograd.Function):
    """The same two functions without the dispatcher's Python in between."""

    @classmethod
    def apply(cls, *inputs):
        if torch._C._are_functorch_transforms_active():
            return super().apply(*inputs)
        return super(torch.autograd.Function, cls).apply(*inputs)  # torch's own looks at the signature in every call

    @staticmethod
    def forward(*inputs):
        with torch._C._AutoDispatchBelowAutograd():
            return _ops.rasterize(*inputs)

    setup_context = staticmethod(_setup_context)

    @staticmethod
    @once_differentiable
    def backward(ctx, *gradients):
        return _backward(ctx, *gradients)
