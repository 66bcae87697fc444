"""LPIPS (Zhang et al. 2018, version 0.1), DISTS (Ding et al. 2020) and ST-LPIPS (Ghildyal and Liu 2022).

The packages `lpips` and `DISTS-pytorch` contain the weights of features; the networks have torchvision's weights for
ImageNet, from a given folder, or for LPIPS from torch's cache or a download into it. A network without weights is never
used. `stlpips-pytorch` contains all weights.
"""

from __future__ import annotations

import contextlib
import hashlib
import http.client
import importlib
import os
import socket
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from unittest import mock

import torch
from torch import library, nn

from groundwork.files.plain_files import plain_path
from groundwork.files.tensor_files import read_tensors
from utils.system_utils import UserError

NETS = {"alex": "alexnet", "vgg": "vgg16", "squeeze": "squeezenet1_1"}  # backbones, and torchvision's names for them
# torchvision's weights for ImageNet. Its import takes seconds, which a machine without the files should not wait for.
_FILES = {"alex": "alexnet-owt-7be5be79.pth", "vgg": "vgg16-397923af.pth", "squeeze": "squeezenet1_1-b8a52dc0.pth"}
_SITE = "https://download.pytorch.org/models"
MIN_SIDE = {"vgg": 16, "alex": 31, "stlpips": 21}  # pixels; smaller images shrink to nothing in pooling
_OF_DISTS = "f5e65c96230b7f6ca995691647d482237e4cab8a50c5c4a5784f219ef0748218"  # SHA-256 of its package's weights.pt
_OF_STLPIPS = "b356b382f96010f77d085ee8343ecd9fd322d0a56e8de2b2d0549fafcad8b9ee"  # of its shift-tolerant AlexNet
_DOWNLOAD_TIMEOUT = 10.0  # seconds without an answer before the network counts as absent

TOLD = "told"  # GS_DOWNLOAD where an earlier command has said what to do


class LpipsUnavailable(Exception):
    """LPIPS cannot be computed here; the text names the missing file and its place."""


def import_lpips() -> ModuleType:
    """Import the `lpips` package, also if torch is CPU-only. Raises LpipsUnavailable without it."""
    try:
        return _import_with_torchvision("lpips")
    except ImportError as error:
        raise LpipsUnavailable(f"{error}; run pip install -r requirements.txt") from error


def _import_with_torchvision(name: str) -> ModuleType:
    """Import a module that imports torchvision, also if torch is CPU-only.

    With a CPU-only torch, torchvision's wheel cannot load its compiled operators, and its Python side (0.28) fails when
    it attaches fake kernels to two of them. The metrics need neither, so this function declares their schemas and
    repeats the import, but only after the failure, because the real operators' schemas would clash with these.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            importlib.import_module("torchvision")
        except RuntimeError as error:
            if "torchvision::" not in str(error):
                raise
            for broken in [module for module in sys.modules if module.split(".")[0] == "torchvision"]:
                del sys.modules[broken]
            _declare_missing_operators()
        return importlib.import_module(name)


def _declare_missing_operators() -> None:
    """Declare torchvision's operators that its compiled part would declare, so that it imports without that."""
    global _schemas  # the schemas live as long as this object
    _schemas = library.Library("torchvision", "FRAGMENT")
    for name in ("nms", "qnms"):
        if not hasattr(torch.ops.torchvision, name):
            _schemas.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")


def load_network(net: str, folder: Path | None, device: torch.device) -> nn.Module:
    """Load the module of the `lpips` package with one backbone of NETS, for evaluation, without gradients of its own.

    folder: the folder of torchvision's file of the backbone, under its own name; None: torch's cache, then a download.
    Raises LpipsUnavailable without weights, and UserError for a missing or wrong file.
    """
    # The import takes seconds, which nobody should wait for who has no weights.
    state = _load_from_cache(net) if folder is None else None
    lpips = import_lpips()
    state = state or _load_state(weights_file(net, folder))
    with _without_weights(net):
        model = lpips.LPIPS(net=net, pnet_rand=True, verbose=False)
    _fill(model.net, state, net)
    return model.to(device).eval().requires_grad_(False)


def load_dists(folder: Path, device: torch.device) -> nn.Module:
    """Load the module of the package DISTS-pytorch, as `load_network` does for LPIPS.

    Raises LpipsUnavailable without the package or torchvision's VGG-16 in the folder, and UserError for wrong files.
    """
    if not (file := folder / Path(_find_url("vgg")).name).is_file():
        raise LpipsUnavailable(_describe_lacking(file, "vgg"))
    try:
        package = importlib.import_module("DISTS_pytorch")
    except ImportError as error:
        raise LpipsUnavailable(f"{error}; run pip install DISTS-pytorch") from error
    with _without_weights("vgg"):
        model = package.DISTS(load_weights=False)
    _fill(model, _load_state(weights_file("vgg", folder)), "vgg")
    file = _check_file(Path(package.__file__).with_name("weights.pt"), _OF_DISTS, "install DISTS-pytorch again")
    model.load_state_dict(_load_state(file), strict=False)
    return model.to(device).eval().requires_grad_(False)


def import_stlpips() -> ModuleType:
    """Import the module of the package stlpips-pytorch that has its network. UserError without the package.

    The package imports two others that it neither lists nor needs here, so stand-ins take their place.
    """
    unneeded = {"IPython", "torchsummary"} - sys.modules.keys()
    sys.modules.update(dict.fromkeys(unneeded, SimpleNamespace(embed=None, summary=None)))
    try:
        return _import_with_torchvision("stlpips_pytorch.stlpips")
    except ImportError as error:
        said = f"ST-LPIPS needs the package stlpips-pytorch ({error}); `pip install '.[stlpips]'`"
        raise UserError(said) from error
    finally:
        for name in unneeded:
            del sys.modules[name]


def load_stlpips(device: torch.device) -> nn.Module:
    """Load ST-LPIPS, called like LPIPS, with the package's default network. Nothing is downloaded."""
    package = import_stlpips()
    model = package.LPIPS(pretrained=False, net="alex", variant="shift_tolerant", verbose=False)
    file = Path(package.__file__).with_name("weights") / "vST0.0" / "alex_shift_tolerant.pth"
    state = _load_state(_check_file(file, _OF_STLPIPS, "install stlpips-pytorch again"))
    model.load_state_dict(state, strict=False)  # which names the last layers once, and the model twice
    return model.to(device).eval().requires_grad_(False)


@contextlib.contextmanager
def _without_weights(net: str) -> Iterator[None]:
    """Let torchvision's network neither download nor draw weights: they stay without memory until `_fill`."""
    models = importlib.import_module("torchvision.models")
    with torch.device("meta"):
        empty = getattr(models, NETS[net])()
    with mock.patch.object(models, NETS[net], lambda **_: empty):
        yield


def _fill(model: nn.Module, state: dict[str, torch.Tensor], net: str) -> None:
    """Fill convolutions from torchvision's `features`; names there end in the layer, and weight or bias."""
    own = [name for name in model.state_dict() if name.endswith(("weight", "bias"))]
    try:
        found = {name: state[f"features.{name.split('.', 1)[1]}"] for name in own}
        model.load_state_dict(found, strict=False, assign=True)
    except (LookupError, TypeError, RuntimeError) as error:
        raise UserError(f"the file does not have the weights of {NETS[net]}; replace it by {_find_url(net)}") from error


def _check_file(file: Path, digest: str, remedy: str) -> Path:
    """Return the file if its SHA-256 begins with `digest`; else, or if it is missing, UserError."""
    try:
        found = hashlib.sha256(plain_path(file).read_bytes()).hexdigest()
    except OSError as error:
        raise UserError(f"cannot read {file} ({error.strerror}); {remedy}") from error
    if not found.startswith(digest):
        raise UserError(f"{file} is damaged: its SHA-256 begins with {found[:8]}, not with {digest[:8]}; {remedy}")
    return file


def weights_file(net: str, folder: Path) -> Path:
    """Find torchvision's file of a backbone in a folder; UserError if it is missing, damaged or another one."""
    file = folder / Path(_find_url(net)).name
    if not file.exists():
        raise UserError(_describe_lacking(file, net))
    return _check_file(file, _find_digest(file), f"replace it by {_find_url(net)}")


def _describe_lacking(file: Path, net: str) -> str:
    return (
        f"{file.parent} has no file {file.name}, the weights of {NETS[net]}; give the folder that has it as --weights, "
        f"or download {_find_url(net)} into this one"
    )


def _find_url(net: str) -> str:
    return f"{_SITE}/{_FILES[net]}"


def _find_digest(file: Path) -> str:
    """The first digits of the SHA-256, from the end of the name of a torchvision file."""
    return file.stem.rpartition("-")[2]


def _load_state(file: Path) -> dict[str, torch.Tensor]:
    try:
        return read_tensors(file, legacy=True)  # torchvision's own files are older than torch 1.6
    except (OSError, ValueError) as error:
        raise UserError(f"{file} is not a state dict of torchvision: {error}; download it again") from error


def _load_from_cache(net: str) -> dict[str, torch.Tensor]:
    """Load the weights of torchvision's network `net` from torch's cache; download them if they are missing."""
    url = _find_url(net)
    cached = Path(torch.hub.get_dir()) / "checkpoints" / url.rsplit("/", 1)[1]
    if not cached.is_file() and not _download(url, cached):
        forbidden, weights = os.environ.get("GS_DOWNLOAD"), f"the weights of {NETS[net]}"
        place = f"put {url} at {cached} or into the folder of --weights"
        if forbidden == TOLD:
            raise LpipsUnavailable(f"{weights} are missing, as told above")
        if forbidden == "0":
            raise LpipsUnavailable(f"GS_DOWNLOAD=0 forbids downloading {weights}; unset it, or {place}")
        raise LpipsUnavailable(f"{weights} cannot be downloaded; check the network, or {place}")
    return _load_state(cached)


def _download(url: str, file: Path) -> bool:
    """Download a file whose name ends in the first digits of its SHA-256.

    False if the download fails, and at once if one failed before or the environment forbids it (GS_DOWNLOAD=0, or
    TOLD).
    """
    global _network_failed
    if _network_failed or os.environ.get("GS_DOWNLOAD") in ("0", TOLD):
        return False
    before = socket.getdefaulttimeout()
    socket.setdefaulttimeout(_DOWNLOAD_TIMEOUT)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        torch.hub.download_url_to_file(url, str(file), hash_prefix=_find_digest(file))
    except (OSError, RuntimeError, http.client.HTTPException):  # no network, refused, or a damaged download
        _network_failed = True
    finally:
        socket.setdefaulttimeout(before)
    return not _network_failed


_network_failed = False
