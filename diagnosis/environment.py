"""Checks of the installation: packages, GPU, extensions and their versions, and the rasterizer's result.

Imports only the standard library until the packages are known to be installed.
"""

import importlib
import importlib.metadata
import platform
import re
import shutil
import subprocess
import sys
from pathlib import Path

from diagnosis.lines import Line

ROOT = Path(__file__).resolve().parents[1]
EXTENSIONS = {  # folder and distribution: package
    "diff-gaussian-rasterization": "diff_gaussian_rasterization",
    "fused-ssim": "fused_ssim",
    "simple-knn": "simple_knn",
}
WHOLE = "gaussian-splatting"  # the distribution of all three
_INSTALL = "pip install -r requirements.txt"
# Largest difference of the rasterizer in float32 from its oracle on one splat: rounding of some dozen operations.
_TOLERANCE = 1e-5


def check_packages() -> list[Line]:
    """Packages of requirements.txt: whether they are installed, in any version."""
    missing, versions = [], []
    for name in _required():
        found = _version(name)
        missing += [] if found else [name]
        versions += [f"{name} {found}"] if found else []
    if missing:
        return [Line(f"packages are missing: {', '.join(missing)}", f"run `{_INSTALL}`")]
    return [Line(f"Python {platform.python_version()}, {', '.join(versions)}")]


def check_build() -> list[Line]:
    """torch and its CUDA, the extensions and their versions; torch must be installed."""
    import torch

    lines = _check_gpu(torch)
    for name, package in EXTENSIONS.items():
        lines += _check_extension(name, package)
    if extensions_load():
        lines += _check_rasterizer(torch)
    return lines


def extensions_load() -> bool:
    """Whether all three extensions can be imported, and are those of this code."""
    try:
        importlib.import_module("utils.host.extensions")
        for package in EXTENSIONS.values():
            importlib.import_module(package)
    except ImportError:
        return False
    return True


def _required() -> list[str]:
    text = (ROOT / "requirements.txt").read_text(encoding="utf-8")
    names = dict.fromkeys(re.findall(r"^([A-Za-z0-9_-]+)==", text, re.MULTILINE))
    if sys.platform == "linux" and platform.machine() != "x86_64":
        names.pop("pycolmap", None)  # has no wheel there; COLMAP models are read without it
    return list(names)


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _check_gpu(torch) -> list[Line]:
    if torch.cuda.is_available():
        name, (major, minor) = torch.cuda.get_device_name(), torch.cuda.get_device_capability()
        return [Line(f"GPU {name}, compute capability {major}.{minor}, CUDA {torch.version.cuda} of torch")]
    gpu = _nvidia_gpu()
    if gpu and torch.version.cuda is None:
        return [
            Line(f"{gpu} is there, but torch {torch.__version__} has no CUDA", f"install torch with CUDA: {_INSTALL}")
        ]
    if gpu:
        return [
            Line(
                f"{gpu} is there, but torch (CUDA {torch.version.cuda}) cannot use it",
                "update the driver, and check whether CUDA_VISIBLE_DEVICES hides it",
            )
        ]
    return [Line("no NVIDIA GPU; everything runs on the CPU")]


def _nvidia_gpu() -> str:
    """Name of the first GPU that the driver's own tool lists; empty if there is none."""
    tool = shutil.which("nvidia-smi")
    if not tool:
        return ""
    try:
        done = subprocess.run([tool, "-L"], capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.split("(UUID")[0].strip() if done.returncode == 0 else ""


def _check_extension(name: str, package: str) -> list[Line]:
    again = f"run `pip install ./submodules/{name}`"
    installed = _version(name) or _version(WHOLE)
    if installed is None:
        return [Line(f"the extension {name} is not installed", again)]
    wanted = (ROOT / "version.txt").read_text(encoding="utf-8").strip()
    if installed.partition("+")[0] != wanted:
        return [Line(f"the extension {name} is version {installed}, but this code is {wanted}", again)]
    try:
        module = importlib.import_module(package)
    except ImportError as error:
        return [Line(f"the extension {name} does not load ({error})", again)]
    folder = Path(module.__file__).parent
    sources = ROOT / "submodules" / name / package
    paths = [path.relative_to(sources) for path in sorted(sources.rglob("*.py"))]
    stale = [str(path) for path in paths if _differ(sources / path, folder / path)]
    if stale:
        return [Line(f"the extension {name} was installed from other sources than these ({', '.join(stale)})", again)]
    return [Line(f"extension {name} {installed}")]


def _differ(source: Path, installed: Path) -> bool:
    return not installed.is_file() or source.read_bytes() != installed.read_bytes()


def _check_rasterizer(torch) -> list[Line]:
    """One splat against the float64 oracle, on every device that training could use."""
    import diff_gaussian_rasterization as rasterizer
    from diff_gaussian_rasterization import reference

    from utils.system_utils import compute_device

    device = compute_device()
    if torch.cuda.is_available() and device.type != "cuda":
        return [
            Line(
                "the rasterizer was built without CUDA, so the GPU is not used",
                "set CUDA_HOME to a CUDA toolkit of torch's version and run `pip install --force-reinstall "
                "./submodules/diff-gaussian-rasterization ./submodules/fused-ssim ./submodules/simple-knn`",
            )
        ]
    settings = rasterizer.GaussianRasterizationSettings(
        image_height=20, image_width=30, tanfovx=0.75, tanfovy=0.5, bg=torch.tensor([0.1, 0.2, 0.3]),
        scale_modifier=1.0, viewmatrix=torch.eye(4), projmatrix=_projection(torch), sh_degree=0,
        campos=torch.zeros(3), prefiltered=False, debug=False, antialiasing=False,
    )  # fmt: skip
    splat = {
        "means": torch.tensor([[0.3, -0.1, 2.0]]),
        "opacities": torch.tensor([[0.8]]),
        "scales": torch.tensor([[0.4, 0.2, 0.3]]),
        "rotations": torch.tensor([[0.8, 0.2, 0.4, -0.3]]),
        "colors": torch.tensor([[0.9, 0.5, 0.1]]),
    }
    splat["rotations"] = torch.nn.functional.normalize(splat["rotations"])
    oracle = reference.render(**splat, means2d=torch.zeros(1, 3), settings=settings)
    moved = {name: tensor.to(device) for name, tensor in splat.items()}
    tensors = {name: value.to(device) for name, value in settings._asdict().items() if torch.is_tensor(value)}
    try:
        ours = rasterizer.rasterize(
            **moved, means2d=torch.zeros(1, 3, device=device), settings=settings._replace(**tensors)
        ).color.cpu()
    except RuntimeError as error:
        first = str(error).splitlines()[0]
        return [
            Line(f"the rasterizer fails on {device} ({first})", "install it again: pip install --force-reinstall .")
        ]
    error = float((ours - oracle.color).abs().max())
    if not error < _TOLERANCE:
        remedy = "install it again: pip install --force-reinstall ./submodules/diff-gaussian-rasterization"
        return [Line(f"the rasterizer on {device} is {error:.1e} off the oracle", remedy)]
    return [Line(f"rasterizer on {device} agrees with its float64 oracle to {error:.0e}")]


def _projection(torch):
    """Transposed projection of the test view: openings 0.75 and 0.5 (tangents), near 0.01, far 100."""
    near, far = 0.01, 100.0
    matrix = torch.zeros(4, 4)
    matrix[0, 0], matrix[1, 1] = 1 / 0.75, 1 / 0.5
    matrix[2, 2], matrix[3, 2], matrix[2, 3] = far / (far - near), -far * near / (far - near), 1.0
    return matrix
