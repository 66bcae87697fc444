"""setuptools' build backend, with access to the environment's packages.

pip's isolation would hide the installed torch, and `requires = ["torch"]` would build against another one. Each
extension's build_backend.py re-exports this module, since pip accepts a backend only from inside the folder it builds.
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
    """Require torch as pinned in requirements.txt, unless the environment has one."""
    requires = build_meta.get_requires_for_build_wheel(config_settings)
    if find_spec("torch") is None:
        requirements = Path(__file__).resolve().parents[2] / "requirements.txt"
        requires += re.findall(r"^torch==.*", requirements.read_text(), re.MULTILINE)
    return requires
