"""`pip install .` installs the dependencies and the three extensions, but not the code, which runs from this folder.

Packages called `utils` and `scene` would clash with others in a shared environment. The three are one distribution
here; each can be installed by itself too, from its folder. With GS_CUDA=1 the version tells the CUDA of the kernels.
"""

import os
import re
import sys
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

from setuptools import setup

ROOT = Path(__file__).resolve().parent
sys.path.insert(0, str(ROOT / "submodules" / "common"))

from build_extension import OLDEST_TORCH, VERSION, cuda_version, extension_options, find_nvcc  # noqa: E402

NEWEST_TORCH = (2, 13)  # that was tried
EXTENSIONS = ("diff-gaussian-rasterization", "fused-ssim", "simple-knn")


def read_requirements() -> list[str]:
    """Return the lines of requirements.txt; where torch is installed, with a range of its versions in place of the pin.

    So pip keeps the torch that is there. The range begins with OLDEST_TORCH and ends with NEWEST_TORCH, or has no end
    if the installed torch is newer. torchvision may then have any version.
    """
    lines = (ROOT / "requirements.txt").read_text(encoding="utf-8").splitlines()
    lines = [line for line in lines if line and not line.startswith("#")]
    if find_spec("torch"):
        tried = tuple(map(int, metadata.version("torch").split(".")[:2])) <= NEWEST_TORCH
        newest = f",<{NEWEST_TORCH[0]}.{NEWEST_TORCH[1] + 1}" if tried else ""
        fitting = {"torch": "torch>={}.{}".format(*OLDEST_TORCH) + newest, "torchvision": "torchvision"}
        lines = [re.sub(r"^(torch|torchvision)==.*", lambda pin: fitting[pin[1]], line) for line in lines]
    return lines


def version() -> str:
    """Tell a wheel with CUDA kernels from one without."""
    return f"{VERSION}+cu{cuda_version(find_nvcc(None))[0]}" if os.environ.get("GS_CUDA") == "1" else VERSION


setup(
    name="gaussian-splatting",
    version=version(),
    license="Apache-2.0",
    extras_require={
        "export": [  # .usdz, .spz and meshes
            "fast-simplification==0.2.0",
            'scikit-image==0.25.2; python_version < "3.11"',
            'scikit-image==0.26.0; python_version >= "3.11"',
            'usd-core==26.8; python_version < "3.11"',
            'usd-core==26.11; python_version >= "3.11"',
            "xatlas==0.0.11",
            "zstandard==0.25.0",
        ],
        "heic": ["pillow-heif==1.8.1"],  # photos of convert.py
        "stlpips": ["stlpips-pytorch==0.0.2"],  # metrics.py --stlpips; in part CC BY-NC-SA 4.0
        "video": ["imageio-ffmpeg==0.8.1"],  # convert.py --video, render.py --path
        "viewer": ["viser==1.1.1"],  # view.py, train.py --viewer
    },
    install_requires=read_requirements(),
    **extension_options({name.replace("-", "_"): ROOT / "submodules" / name for name in EXTENSIONS}),
)
