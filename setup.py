"""`pip install .`: the dependencies and the three extensions. The code itself is run from this folder, not installed:
`utils` and `scene` are no names for an environment that others share.
"""

import importlib.metadata
import re
import site
from pathlib import Path

from setuptools import setup

ROOT = Path(__file__).resolve().parent
EXTENSIONS = ("diff-gaussian-rasterization", "fused-ssim", "simple-knn")


def requirements() -> list[str]:
    """requirements.txt; but a torch that is installed stays, and torchvision follows it."""
    lines = (ROOT / "requirements.txt").read_text().splitlines()
    lines = [line for line in lines if line and not line.startswith("#")]
    # pip's isolation hides the environment from an import, not from a look at its folders.
    if any(importlib.metadata.distributions(name="torch", path=site.getsitepackages())):
        lines = [re.sub(r"^(torch|torchvision)==.*", r"\1", line) for line in lines]
    return lines


def extension_url(name: str) -> str:
    # "/.": pip would take a folder named like "simple-knn" for a release and serve a wheel cached from older sources.
    return (ROOT / "submodules" / name).as_uri() + "/."


setup(
    name="gaussian-splatting",
    version="0.1.0",
    license="Apache-2.0",
    python_requires=">=3.10",
    packages=[],
    py_modules=[],
    extras_require={"video": ["imageio-ffmpeg==0.8.1"]},  # convert.py --video
    install_requires=requirements() + [f"{name} @ {extension_url(name)}" for name in EXTENSIONS],
)
