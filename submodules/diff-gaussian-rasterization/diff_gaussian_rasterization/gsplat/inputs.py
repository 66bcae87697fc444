"""The arguments of `gsplat.rasterization`: what is refused, and what an image gets of them."""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diff_gaussian_rasterization.checks import check_tensors, whole_number

MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
_CHOICES = {
    "render_mode": MODES,
    "camera_model": ("pinhole", "fisheye", "ortho"),
    "rasterize_mode": ("classic", "antialiased"),
}
_TILE = 16  # px
_NO_UT = "take camera_model='fisheye', or a Lens with rasterize_channels"
_NO_RAYS = "take projection='ray' with rasterize"
_UNSUPPORTED = {
    "distributed": "train with torchrun and train.py",
    **dict.fromkeys(("with_eval3d", "return_normals", "rays"), _NO_RAYS),
    **dict.fromkeys(
        ("with_ut", "ut_params", "radial_coeffs", "tangential_coeffs", "thin_prism_coeffs", "ftheta_coeffs",
         "lidar_coeffs", "external_distortion_coeffs", "viewmats_rs"), _NO_UT,
    ),
}  # fmt: skip
_NEEDED = {"means": "(..., N, 3)", "viewmats": "(..., C, 4, 4)"}
_OTHERS = ("quats", "scales", "opacities", "colors", "Ks", "backgrounds", "covars", "extra_signals")


class Call(NamedTuple):
    """The arguments that all images of a call share."""

    size: tuple[int, int]  # height, width
    degree: int | None  # of SH
    signal_degree: int | None
    colored: bool  # whether colours are shown, and below, whether depths are
    deep: bool
    mean_depth: bool  # depths over alpha
    antialiased: bool
    eps2d: float  # px^2
    clip: float  # px
    near: float
    far: float
    model: str
    by_z: bool  # depths are along the axis, else distances
    packed: bool
    absgrad: bool


class Item(NamedTuple):
    """The Gaussians and the camera of an image."""

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    covars: Tensor | None  # (N, 6)
    opacities: Tensor
    colors: Tensor | None  # (N, D), or SH (N, K, D)
    signals: Tensor | None  # the same
    view: Tensor  # (4, 4) world to view
    K: Tensor  # (3, 3)
    background: Tensor | None  # (D,)


def check_call(given: dict[str, Any]) -> tuple[Call, Tensor | None, int]:
    """Check the arguments of `rasterization`. Return the call, the backgrounds and tile_size.

    ValueError, or TypeError, for wrong arguments.
    """
    for name, remedy in _UNSUPPORTED.items():
        if given[name] is not None and given[name] is not False:
            raise ValueError(f"{name} is not supported; {remedy}")
    _check_renderer(given["renderer_config"])
    shutter, eps2d, mode = given["rolling_shutter"], given["eps2d"], given["render_mode"]
    check_tensors({name: given[name] for name in (*_NEEDED, *_OTHERS)})
    for name, shape in _NEEDED.items():
        if (found := given[name]) is None or found.dim() < 2:
            raise ValueError(f"{name} must be {shape}, got {None if found is None else tuple(found.shape)}")
    if shutter is not None and getattr(shutter, "name", "GLOBAL") != "GLOBAL":
        raise ValueError("rolling_shutter is not supported; take poses of a global shutter")
    if mode in ("d", "Ed", "RGB-d", "RGB-Ed"):
        along_axis = mode.upper().replace("-", "+")
        raise ValueError(f"render_mode {mode!r} needs with_eval3d, which is not supported; take {along_axis!r}")
    for name, choices in _CHOICES.items():
        if given[name] not in choices:
            raise ValueError(f"{name} must be one of {', '.join(choices)}, got {given[name]!r}")
    if not 0 <= eps2d <= 1:
        raise ValueError(f"eps2d must be 0 to 1 px^2, got {eps2d}")
    degrees = [
        None if given[name] is None else whole_number(name, given[name], 0)
        for name in ("sh_degree", "extra_signals_sh_degree")
    ]
    behind, means = given["backgrounds"], given["means"]
    if given["packed"] and behind is not None and behind.dim() == 1:  # gsplat's rows that are packed have no cameras
        behind = behind.expand(*means.shape[:-2], *given["viewmats"].shape[-3:-2], -1)
    width, height = (whole_number(name, given[name]) for name in ("width", "height"))
    tile = _TILE if given["tile_size"] is None else whole_number("tile_size", given["tile_size"])
    call = Call(
        (height, width), *degrees, mode.startswith("RGB"), mode.endswith("D"), mode.endswith("ED"),
        given["rasterize_mode"] == "antialiased", float(eps2d), given["radius_clip"], float(given["near_plane"]),
        given["far_plane"], given["camera_model"], bool(given["global_z_order"]), bool(given["packed"]),
        bool(given["absgrad"]),
    )  # fmt: skip
    return call, behind, tile


def _check_renderer(config: Any) -> None:
    """Refuse renderer classes of gsplat, by their names, except its default: only that one has images without rays."""
    name = type(config).__name__
    if config is None or name == "RendererConfig_MixedBatch":
        return
    if all(base.__name__ != "RendererConfig" for base in type(config).__mro__):
        raise TypeError(f"renderer_config must be a RendererConfig or None, got {name}")
    if name != "RendererConfig_ParallelBatch":
        raise NotImplementedError(f"there is no renderer of {name}")
    raise ValueError(f"renderer_config {name} needs with_eval3d=True, which is not supported; {_NO_RAYS}")


def split_images(call: Call, given: Item, form: tuple[int, ...]) -> list[Item]:
    """Split the arguments of a call into those of its images: batch by batch, and in each camera by camera.

    ValueError for tensors of wrong shapes or dtypes.

    given: tensors of the call, with axes of batches, and of cameras where the argument has them.
    form: numbers of batches, one for each axis of batches, then the number of cameras.
    """
    if not all(form):
        raise ValueError(f"there must be an image to render, got batches and cameras {form}")
    if given.covars is not None:
        given = given._replace(quats=None, scales=None)
    given = given._replace(colors=given.colors if call.colored else None, K=given.K.detach().to(given.means.device))
    _check_shapes(call, given, form)
    if given.covars is not None:
        upper = (0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)
        given = given._replace(covars=torch.stack([given.covars[..., i, j] for i, j in upper], -1))
    *batch, cameras = form
    axes = 2, 2, 2, 2, 1, 2 + (call.degree is not None), 2 + (call.signal_degree is not None), 2, 2, 1
    images = []
    for place in range(math.prod(batch)):
        own = [_select_batch(values, len(batch), n, place) for values, n in zip(given, axes, strict=True)]
        for camera in range(cameras):
            of_camera = (v if v is None or v.dim() == n else v[camera] for v, n in zip(own, axes, strict=True))
            images.append(Item(*of_camera))
    return images


def _select_batch(values: Tensor | None, batch: int, axes: int, place: int) -> Tensor | None:
    """Return the values of one batch; all values, where they have no axes of batches.

    batch: number of leading axes of batches.
    axes: number of axes without them.
    place: index of the batch.
    """
    if values is None or not batch or values.dim() == axes:
        return values
    return values.flatten(0, batch - 1)[place]


def _check_shapes(call: Call, given: Item, form: tuple[int, ...]) -> None:
    """Raise ValueError for a tensor whose shape or dtype does not fit the call.

    form: numbers of batches, then of cameras.
    """
    batch, means = (form[:-1],), given.means
    count, each, both = means.shape[-2], (form,), (form[:-1], form)
    shapes = [("means", means, batch, (count, 3)), ("opacities", given.opacities, batch, (count,))]
    shapes += [("viewmats", given.view, each, (4, 4)), ("Ks", given.K, each, (3, 3))]
    if given.covars is None:
        shapes += [("quats", given.quats, batch, (count, 4)), ("scales", given.scales, batch, (count, 3))]
    else:
        shapes.append(("covars", given.covars, batch, (count, 3, 3)))
    for name, values, degree in (
        ("colors", given.colors, call.degree),
        ("extra_signals", given.signals, call.signal_degree),
    ):
        if values is None and (name == "extra_signals" or not call.colored):
            continue
        harmonic, bands = degree is not None, 0 if degree is None else (degree + 1) ** 2
        found = None if values is None else tuple(values.shape)
        if found is None or found[-2 - harmonic : -1 - harmonic] != (count,) or (harmonic and found[-2] < bands):
            form, of = (f"{bands} or more, D", f" of degree {degree}") if harmonic else ("D", "")
            raise ValueError(f"{name}{of} must be (..., {count}, {form}), got {found}")
        shapes.append((name, values, ((), *both) if harmonic else both, (count, *found[-1 - harmonic :])))
    if given.background is not None:
        width = (given.colors if call.colored else given.background).shape[-1:]
        shapes.append(("backgrounds", given.background, each, width))
    for name, values, leads, tail in shapes:
        if values is None or all(values.shape != (*lead, *tail) for lead in leads):
            raise ValueError(
                f"{name} must be {(*leads[0], *tail)}, got {None if values is None else tuple(values.shape)}"
            )
        if values.dtype != means.dtype and name not in ("Ks", "backgrounds"):
            raise ValueError(f"{name} must be {means.dtype} like means, got {values.dtype}")
