"""`pip install .` installs the dependencies and the three extensions, but not the code, which runs from this folder.

Packages called `utils` and `scene` would clash with others in a shared environment.
"""

import importlib.metadata
import re
import site
from pathlib import Path

from setuptools import setup

ROOT = Path(__file__).resolve().parent
EXTENSIONS = ("diff-gaussian-rasterization", "fused-ssim", "simple-knn")


def requirements() -> list[str]:
    """Read requirements.txt. If torch is installed, do not pin torch and torchvision, so that it stays."""
    lines = (ROOT / "requirements.txt").read_text(encoding="utf-8").splitlines()
    lines = [line for line in lines if line and not line.startswith("#")]
    # pip's isolation hides the environment's packages from imports, but its folders can be read.
    if any(importlib.metadata.distributions(name="torch", path=site.getsitepackages())):
        lines = [re.sub(r"^(torch|torchvision)==.*", r"\1", line) for line in lines]
    return lines


def extension_url(name: str) -> str:
    # Without "/.", pip takes a folder named like "simple-knn" for a release, and uses a wheel cached from old sources.
    return (ROOT / "submodules" / name).as_uri() + "/."


setup(
    name="gaussian-splatting",
    version=(ROOT / "version.txt").read_text(encoding="utf-8").strip(),
    license="Apache-2.0",
    python_requires=">=3.10",
    packages=[],
    py_modules=[],
    extras_require={
        "export": [  # .usdz and .spz
            'usd-core==26.8; python_version < "3.11"',
            'usd-core==26.11; python_version >= "3.11"',
            "zstandard==0.25.0",
        ],
        "video": ["imageio-ffmpeg==0.8.1"],  # convert.py --video, render.py --path
        "viewer": ["viser==1.1.1"],  # view.py, train.py --viewer
    },
    install_requires=requirements() + [f"{name} @ {extension_url(name)}" for name in EXTENSIONS],
)
