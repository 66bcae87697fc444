"""setuptools' build backend with the environment's packages in sight: pip's isolation would hide the torch that is
installed, and `requires = ["torch"]` would build against another one. Each extension's build_backend.py hands this on
(pip accepts a backend only from inside the folder it builds).
"""

import re
import site
import sys
from importlib.util import find_spec
from pathlib import Path

sys.path += site.getsitepackages()

from setuptools import build_meta  # noqa: E402
from setuptools.build_meta import *  # noqa: E402, F403


def get_requires_for_build_wheel(config_settings: dict | None = None) -> list[str]:
    """torch as requirements.txt pins it where the environment has none; nothing where it has one."""
    requires = build_meta.get_requires_for_build_wheel(config_settings)
    if find_spec("torch") is None:
        requirements = Path(__file__).resolve().parents[2] / "requirements.txt"
        requires += re.findall(r"^torch==.*", requirements.read_text(), re.MULTILINE)
    return requires
