"""Checks of the installation: packages, GPU, extensions and their versions, and the rasterizer's result.

Imports only the standard library until the packages are known to be installed.
"""

import importlib
import importlib.metadata
import math
import platform
import re
import subprocess
import sys
from pathlib import Path

from groundwork.finding import Finding, fine
from groundwork.host.programs import find_program

ROOT = Path(__file__).resolve().parents[2]
EXTENSIONS = ("diff-gaussian-rasterization", "fused-ssim", "simple-knn")  # folders and distributions of packages
WHOLE = "gaussian-splatting"  # the distribution of all three
_INSTALL = "pip install -r requirements.txt"
# Largest difference of the rasterizer in float32 from its oracle on one splat: rounding of some dozen operations.
_TOLERANCE = 1e-5


def check_packages() -> list[Finding]:
    """Check that the packages of requirements.txt are installed, in any version."""
    versions = {name: _read_version(name) for name in _list_required()}
    if missing := [name for name, found in versions.items() if not found]:
        return [Finding(f"packages are missing: {', '.join(missing)}", f"run `{_INSTALL}`")]
    found = ", ".join(f"{name} {version}" for name, version in versions.items())
    lines = [fine(f"Python {platform.python_version()}, {found}")]
    if not _read_version("tensorboard"):
        lines.append(fine("no TensorBoard, so trainings write no event files (pip install tensorboard brings it)"))
    return lines


def check_build() -> list[Finding]:
    """Check torch and its CUDA, the extensions and their versions; torch must be installed."""
    import torch

    lines = [_check_gpu(torch), *map(_check_extension, EXTENSIONS)]
    return [*lines, _check_rasterizer(torch)] if can_load_extensions() else lines


def can_load_extensions() -> bool:
    """Tell if all three extensions can be imported, and are those of this code."""
    try:
        importlib.import_module("groundwork.host.extensions")
        for name in EXTENSIONS:
            importlib.import_module(_name_package(name))
    except ImportError:
        return False
    return True


def _name_package(extension: str) -> str:
    """Return the name under which Python imports an extension."""
    return extension.replace("-", "_")


def _list_required() -> list[str]:
    """List the packages that requirements.txt pins, without those that this machine cannot have."""
    text = (ROOT / "requirements.txt").read_text(encoding="utf-8")
    names = dict.fromkeys(re.findall(r"^([A-Za-z0-9_-]+)==", text, re.MULTILINE))
    if sys.platform == "linux" and platform.machine() != "x86_64":
        names.pop("pycolmap", None)  # has no wheel there; COLMAP models are read without it
    return list(names)


def _read_version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _check_gpu(torch) -> Finding:
    """Check that torch can use the NVIDIA GPU, if there is one. torch: the imported package."""
    if torch.cuda.is_available():
        from groundwork.host.machine import OLDEST_GPU

        name, found = torch.cuda.get_device_name(), torch.cuda.get_device_capability()
        remedy = f"use a GPU of {OLDEST_GPU[0]}.{OLDEST_GPU[1]} or newer, or set CUDA_VISIBLE_DEVICES= to use the CPU"
        text = f"GPU {name}, compute capability {found[0]}.{found[1]}, CUDA {torch.version.cuda} of torch"
        return Finding(text, remedy) if found < OLDEST_GPU else fine(text)
    if not (gpu := _find_nvidia_gpu()):
        return fine("no NVIDIA GPU; everything runs on the CPU")
    if torch.version.cuda is None:
        return Finding(
            f"{gpu} is there, but torch {torch.__version__} has no CUDA", f"install torch with CUDA: {_INSTALL}"
        )
    remedy = "update the driver, and check whether CUDA_VISIBLE_DEVICES hides it"
    return Finding(f"{gpu} is there, but torch (CUDA {torch.version.cuda}) cannot use it", remedy)


def _find_nvidia_gpu() -> str:
    """Name of the first GPU that the driver's own tool lists; empty if there is none."""
    tool = find_program("nvidia-smi")
    if not tool:
        return ""
    try:
        done = subprocess.run([tool, "-L"], capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.split("(UUID")[0].strip() if done.returncode == 0 else ""


def _check_extension(name: str) -> Finding:
    """Check that an extension is installed, loads, and was built from the sources of this repository."""
    package = _name_package(name)
    extension, again = f"the extension {name}", f"run `pip install ./submodules/{name}`"
    installed = _read_version(name) or _read_version(WHOLE)
    if installed is None:
        return Finding(f"{extension} is not installed", again)
    expected = (ROOT / "version.txt").read_text(encoding="utf-8").strip()
    if installed.partition("+")[0] != expected:
        return Finding(f"{extension} is version {installed}, but this code is {expected}", again)
    try:
        folder = Path(importlib.import_module(package).__file__).parent
    except ImportError as error:
        return Finding(f"{extension} does not load ({error})", again)
    sources = ROOT / "submodules" / name / package
    paths = [path.relative_to(sources) for path in sorted(sources.rglob("*.py"))]
    if stale := [str(path) for path in paths if _is_different(sources / path, folder / path)]:
        return Finding(f"{extension} was installed from other sources than these ({', '.join(stale)})", again)
    return fine(f"extension {name} {installed}")


def _is_different(source: Path, installed: Path) -> bool:
    return not installed.is_file() or source.read_bytes() != installed.read_bytes()


def _check_rasterizer(torch) -> Finding:
    """Compare one splat with the float64 oracle, on every device that training could use."""
    import diff_gaussian_rasterization as rasterizer
    from diff_gaussian_rasterization import reference

    from utils.graphics_utils import getProjectionMatrix
    from utils.system_utils import compute_device

    device, again = compute_device(), "pip install --force-reinstall"
    if torch.cuda.is_available() and device.type != "cuda":
        every = " ".join(f"./submodules/{name}" for name in EXTENSIONS)
        remedy = f"set CUDA_HOME to a CUDA toolkit of torch's version and run `{again} {every}`"
        return Finding("the rasterizer was built without CUDA, so the GPU is not used", remedy)
    projection = getProjectionMatrix(0.01, 100.0, 2 * math.atan(0.75), 2 * math.atan(0.5)).T.contiguous()
    settings = rasterizer.GaussianRasterizationSettings(
        image_height=20, image_width=30, tanfovx=0.75, tanfovy=0.5, bg=torch.tensor([0.1, 0.2, 0.3]),
        scale_modifier=1.0, viewmatrix=torch.eye(4), projmatrix=projection, sh_degree=0,
        campos=torch.zeros(3), prefiltered=False, debug=False, antialiasing=False,
    )  # fmt: skip
    splat = {
        "means": torch.tensor([[0.3, -0.1, 2.0]]),
        "means2d": torch.zeros(1, 3),
        "opacities": torch.tensor([[0.8]]),
        "scales": torch.tensor([[0.4, 0.2, 0.3]]),
        "rotations": torch.nn.functional.normalize(torch.tensor([[0.8, 0.2, 0.4, -0.3]])),
        "colors": torch.tensor([[0.9, 0.5, 0.1]]),
    }
    oracle = reference.render(**splat, settings=settings)
    moved = {name: tensor.to(device) for name, tensor in splat.items()}
    tensors = {name: value.to(device) for name, value in settings._asdict().items() if torch.is_tensor(value)}
    try:
        ours = rasterizer.rasterize(**moved, settings=settings._replace(**tensors)).color.cpu()
    except (AttributeError, RuntimeError) as error:
        return Finding(
            f"the rasterizer fails on {device} ({str(error).splitlines()[0]})", f"install it again: {again} ."
        )
    error = float((ours - oracle.color).abs().max())
    if not error < _TOLERANCE:
        remedy = f"install it again: {again} ./submodules/diff-gaussian-rasterization"
        return Finding(f"the rasterizer on {device} differs from its float64 oracle by {error:.1e}", remedy)
    return fine(f"rasterizer on {device} agrees with its float64 oracle to {error:.0e}")
