"""A second build of the rasterizer, with the standard library's exponential instead of the fast one in math/exp2.h.

The shipped code has no switch for this. The sources are copied under build/, exact_exp2.h replaces that one header, and
the copy is built there. Both builds register the same operators, so each needs its own process.
"""

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import torch

from utils.system_utils import UserError, compute_device

ROOT = Path(__file__).resolve().parents[2]
EXTENSION = "diff-gaussian-rasterization"
HEADER = Path(__file__).with_name("exact_exp2.h")
NOT_BUILT = ("build", "emulation", "tests")  # folders without sources of the extension
BUILDS = ROOT / "build" / "exact_exponential"


def build() -> Path:
    """Build the second rasterizer and return the folder of its package, to be put on PYTHONPATH.

    Builds again only when the sources, the compiler's environment or torch have changed. UserError if the build fails.
    """
    environment = dict(os.environ)
    if compute_device().type == "cuda":  # the installed build has CUDA, so this one needs it too, for the same GPU
        environment.setdefault("TORCH_CUDA_ARCH_LIST", "{}.{}".format(*torch.cuda.get_device_capability()))
        environment["GS_CUDA"] = "1"
    target = BUILDS / _key(environment)
    if not target.is_dir():
        BUILDS.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=BUILDS) as folder:
            copy = copy_sources(Path(folder) / "submodules")
            command = [sys.executable, "setup.py", "--quiet", "build_ext", "--inplace"]
            done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True)
            if done.returncode:
                said = (done.stdout + done.stderr)[-4000:]
                raise UserError(f"building the rasterizer with the exact exponential failed; its output ends:\n{said}")
            shutil.rmtree(copy / "build")
            copy.parent.rename(target)
    return target / EXTENSION


def copy_sources(to: Path) -> Path:
    """Copy the extension and its build files into `to`, replace the header, and return the extension's folder."""
    ignored = shutil.ignore_patterns(*NOT_BUILT, "*.egg-info", "*.so", "__pycache__")
    for name in ("common", EXTENSION):
        shutil.copytree(ROOT / "submodules" / name, to / name, ignore=ignored)
    shutil.copyfile(HEADER, to / EXTENSION / "csrc" / "math" / "exp2.h")
    return to / EXTENSION


def _key(environment: dict[str, str]) -> str:
    """Hash everything that the build depends on."""
    hashed = hashlib.sha256(f"{sys.version} {torch.__version__}".encode())
    for name in ("CXX", "CUDA_HOME", "GS_CUDA", "TORCH_CUDA_ARCH_LIST"):
        hashed.update(f" {name}={environment.get(name)}".encode())
    sources = [HEADER]
    for name in ("common", EXTENSION):
        folder = ROOT / "submodules" / name
        sources += [p for p in folder.rglob("*") if p.suffix in (".py", ".h", ".cpp", ".cu", ".cuh")]
    for source in sorted(sources):
        if not set(NOT_BUILT).intersection(source.relative_to(ROOT).parts):
            hashed.update(str(source.relative_to(ROOT)).encode() + source.read_bytes())
    return hashed.hexdigest()[:16]
