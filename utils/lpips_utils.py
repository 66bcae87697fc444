"""LPIPS (Zhang et al. 2018, version 0.1) through the `lpips` package, with torchvision's ImageNet weights.

The package brings the linear heads. The backbone's weights come from a given file, from torch's cache, or are
downloaded into it. A backbone without weights is never used.
"""

from __future__ import annotations

import http.client
import importlib
import os
import socket
import sys
import warnings
from pathlib import Path
from types import ModuleType

import torch
from torch import library, nn

from splatting.files.tensor_files import read_tensors
from utils.system_utils import UserError

NETS = {"alex": "alexnet", "vgg": "vgg16", "squeeze": "squeezenet1_1"}  # backbones, and torchvision's names for them
# Of files, the first convolution tells the backbones apart. Images below the smallest side (pixels) shrink to nothing
# in pooling.
_FIRST_LAYER = {"vgg": (64, 3, 3, 3), "alex": (64, 3, 11, 11)}
MIN_SIDE = {"vgg": 16, "alex": 31}
_DOWNLOAD_TIMEOUT = 10.0  # seconds without an answer before the network counts as absent

TOLD = "told"  # GS_DOWNLOAD where an earlier command has said what to do


class LpipsUnavailable(Exception):
    """LPIPS cannot be computed here; the text names the missing file and its place."""


def import_lpips() -> ModuleType:
    """Import the `lpips` package, also if torch is CPU-only.

    There torchvision's wheel cannot load its compiled operators, and its Python side (0.28) fails when it attaches fake
    kernels to two of them. LPIPS needs neither, so this declares their schemas and repeats the import. It does so only
    after the failure, because the real operators' schemas would clash with these.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            importlib.import_module("torchvision")
        except RuntimeError as error:
            if "torchvision::" not in str(error):
                raise
            for name in [name for name in sys.modules if name.split(".")[0] == "torchvision"]:
                del sys.modules[name]
            _declare_missing_operators()
        return importlib.import_module("lpips")


def _declare_missing_operators() -> None:
    global _schemas  # the schemas live as long as this object
    _schemas = library.Library("torchvision", "FRAGMENT")
    for name in ("nms", "qnms"):
        if not hasattr(torch.ops.torchvision, name):
            _schemas.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")


def load_network(net: str, weights: list[Path], device: torch.device) -> nn.Module:
    """Load the module of the `lpips` package with one backbone of NETS, for evaluation, without gradients of its own.

    weights: state-dict files in torchvision's format (parameters `features.*`; others are ignored), of which the one
    that fits the backbone, `vgg` or `alex`, is used. Without any, torch's cache is tried, and then the network. Raises
    LpipsUnavailable, or UserError for a file of the wrong kind.
    """
    state = _features_from_files(net, weights) if weights else _features_from_cache(net)
    lpips = import_lpips()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torchvision warns of an argument that lpips still uses
        model = lpips.LPIPS(net=net, pnet_rand=True, verbose=False)  # random only until the next lines
    trunk = model.net.state_dict()  # names are sliceK.N.weight, N being the layer of torchvision's `features`
    model.net.load_state_dict({name: _pick(state, name.split(".", 1)[1], trunk[name], net) for name in trunk})
    return model.to(device).eval().requires_grad_(False)


def _pick(state: dict[str, torch.Tensor], name: str, like: torch.Tensor, net: str) -> torch.Tensor:
    value = state.get(f"features.{name}")
    if not isinstance(value, torch.Tensor) or value.shape != like.shape:
        found = "nothing" if value is None else str(tuple(getattr(value, "shape", ())))
        raise UserError(
            f"the LPIPS weights for {net} have {found} as features.{name}, expected {tuple(like.shape)}; "
            f"give --lpips_weights the state dict of torchvision's {NETS[net]}"
        )
    return value


def _features_from_files(net: str, files: list[Path]) -> dict[str, torch.Tensor]:
    for file in files:
        state = _load_state(file)
        shape = tuple(getattr(state.get("features.0.weight"), "shape", ()))
        if shape not in _FIRST_LAYER.values():
            raise UserError(f"{file} has no weights of torchvision's vgg16 or alexnet (features.0.weight ...)")
        if shape == _FIRST_LAYER[net]:
            return state
    raise LpipsUnavailable(f"no file of --lpips_weights holds torchvision's {NETS[net]}; add it there")


def _load_state(file: Path) -> dict[str, torch.Tensor]:
    try:
        state = read_tensors(file, legacy=True)  # torchvision's own files are older than torch 1.6
    except FileNotFoundError:
        raise UserError(f"no such file: {file} (--lpips_weights)") from None
    except (OSError, ValueError) as error:
        raise UserError(
            f"{file} is not a state dict of torchvision: {error}; give --lpips_weights one that torch has written"
        ) from error
    if not isinstance(state, dict):
        raise UserError(f"{file} holds a {type(state).__name__}, expected a state dict in torchvision's format")
    return state


def _features_from_cache(net: str) -> dict[str, torch.Tensor]:
    import_lpips()  # makes torchvision importable
    models = importlib.import_module("torchvision.models")
    url = models.get_model_weights(NETS[net]).IMAGENET1K_V1.url
    cached = Path(torch.hub.get_dir()) / "checkpoints" / url.rsplit("/", 1)[1]
    if not cached.is_file() and not _download(url, cached):
        if os.environ.get("GS_DOWNLOAD") == TOLD:
            raise LpipsUnavailable("its weights are missing, as told above")
        raise LpipsUnavailable(
            f"its weights are missing; put {url} at {cached}, or name the file with --lpips_weights of metrics.py"
        )
    return _load_state(cached)


def _download(url: str, file: Path) -> bool:
    """Download a file whose name ends in the first digits of its SHA-256.

    False if that fails, and at once if it has failed before or the environment forbids it (GS_DOWNLOAD=0, or
    TOLD).
    """
    global _network_failed
    if _network_failed or os.environ.get("GS_DOWNLOAD") in ("0", TOLD):
        return False
    before = socket.getdefaulttimeout()
    socket.setdefaulttimeout(_DOWNLOAD_TIMEOUT)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        torch.hub.download_url_to_file(url, str(file), hash_prefix=file.stem.rpartition("-")[2])
    except (OSError, RuntimeError, http.client.HTTPException):  # no network, refused, or a damaged download
        _network_failed = True
    finally:
        socket.setdefaulttimeout(before)
    return not _network_failed


_network_failed = False
