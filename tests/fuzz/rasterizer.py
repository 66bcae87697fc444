"""Cases of the rasterizer's arguments: shapes, dtypes, layouts and values, in range and out of it."""

import math
import random
from pathlib import Path

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer
from rasterizer_tools import activated, few, keywords
from torch import Tensor

from tests.workloads.splat_scenes import settings

_VALUES = (0.0, -1.0, 1e-45, 1e-20, 1e10, 1e20, 3e38, -3e38, math.nan, math.inf, -math.inf)
_DTYPES = (torch.float16, torch.float64, torch.int64, torch.bool, torch.complex64)
# What the documentation announces. An assertion of torch's own is no announced error.
_EXPECTED = (TypeError, ValueError, RuntimeError, NotImplementedError, FloatingPointError)


class Rasterizer:
    """The public class with one to three arguments changed, forward and backward."""

    def __init__(self, folder: Path) -> None:
        del folder  # needs no files
        raw, size = few(dtype=torch.float32)
        self._splats, self._settings = activated(raw), settings(**size)

    def run(self, rng: random.Random) -> None:
        arguments = keywords(self._splats)
        if rng.random() < 0.2:
            del arguments["scales"], arguments["rotations"]
            arguments["cov3D_precomp"] = torch.tensor([[0.1, 0.0, 0.0, 0.1, 0.0, 0.1]] * 3)
        if rng.random() < 0.2:
            arguments["colors_precomp"] = arguments.pop("shs")[:, 0]
        camera = self._settings._asdict() | {"antialiasing": rng.random() < 0.5, "debug": rng.random() < 0.1}
        for _ in range(rng.randint(1, 3)):
            changed = rng.choice((arguments, arguments, camera))
            name = rng.choice(list(changed))
            changed[name] = _changed(rng, changed[name]) if _is_plain(changed[name]) else None
        try:
            _render(rng, arguments, camera)
        except _EXPECTED as error:
            assert "INTERNAL ASSERT" not in str(error), str(error)
        except Exception as error:
            if _on_no_device(arguments) or str(error) in (
                "give exactly one of shs and colors_precomp",
                "give exactly one of the pair scales, rotations and cov3D_precomp",
            ):
                return  # the fakes for torch.compile check nothing
            raise


def _render(rng: random.Random, arguments: dict, camera: dict) -> None:
    if rng.random() < 0.7:
        arguments = {
            name: value.detach().requires_grad_() if torch.is_tensor(value) and value.is_floating_point() else value
            for name, value in arguments.items()
        }
    image = GaussianRasterizer(GaussianRasterizationSettings(**camera))(**arguments)[0]
    if image.device.type != "cpu":
        return
    # From there on, products overflow, or cameras are none.
    usual = all((camera[name].abs() < 1e6).all() for name in ("bg", "viewmatrix", "projmatrix", "campos"))
    if usual:
        assert image.isfinite().all(), "the image is not finite"
    opacities = arguments["opacities"].detach()
    if image.requires_grad and ((opacities >= 0) & (opacities <= 1)).all():  # others make gradients of any size
        (image * torch.rand_like(image)).sum().backward()
        for name, value in arguments.items():
            if torch.is_tensor(value) and value.grad is not None and usual:
                assert value.grad.isfinite().all(), f"the gradient of {name} is not finite"


def _on_no_device(arguments: dict) -> bool:
    return any(torch.is_tensor(value) and value.is_meta for value in arguments.values())


def _is_plain(value: object) -> bool:
    """Tell whether a value can be changed further; a tensor may be sparse or endless by now."""
    return not torch.is_tensor(value) or (
        value.layout == torch.strided and not value.is_meta and value.dim() > 0 and 0 < value.numel() < 10_000
    )


def _changed(rng: random.Random, value: object) -> object:
    if not torch.is_tensor(value):
        if isinstance(value, int) and not isinstance(value, bool):
            return rng.choice((0, -1, 1, 2, 3, 4, 17, 5000, 2**24, 2**31, 2**40, None, 1.5))
        return rng.choice((*_VALUES, None, "x", True, 1))
    kind = rng.randrange(9)
    if kind == 0:
        return rng.choice((None, 1.0, "x", [1.0, 2.0, 3.0]))
    if kind == 1:
        return value.to(rng.choice(_DTYPES))
    if kind == 2:
        return _other_shape(rng, value)
    if kind == 3:
        return rng.choice((value.to_sparse(), value.to("meta"), value.transpose(0, -1), value.flip(0)))
    out = value.clone().reshape(-1)
    if not out.is_floating_point():
        return value
    for _ in range(rng.randint(1, 4)):
        out[rng.randrange(len(out))] = rng.choice(_VALUES)
    return out.reshape(value.shape)


def _other_shape(rng: random.Random, value: Tensor) -> Tensor:
    return rng.choice(
        (
            *(value[None], value.reshape(-1), value[:0], value[..., :1], value.new_zeros(()), value.new_zeros(0)),
            *(torch.cat([value, value]), value[:1].expand(value.shape), value[:1].expand(1 << 40, *value.shape[1:])),
        )
    )
