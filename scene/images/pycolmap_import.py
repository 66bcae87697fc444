"""Import of pycolmap, when it is first needed, with its side effects undone."""

import importlib.util
import signal
import sys
import threading
from types import ModuleType

# Pillow's zlib must be in the process before pycolmap's, or writing a PNG aborts (pycolmap 4.2.1, Pillow 13.0).
from PIL import Image  # noqa: F401

from utils.system_utils import UserError


def has_pycolmap() -> bool:
    """Whether pycolmap is installed. It has no wheel for Linux on 64-bit Arm."""
    return "pycolmap" in sys.modules or importlib.util.find_spec("pycolmap") is not None


def import_pycolmap() -> ModuleType:
    """The module `pycolmap`, whose import takes time and loads libraries that a Blender scene does not need.

    UserError where it is not installed.
    """
    if not has_pycolmap():
        raise UserError(
            "pycolmap is not installed, which convert.py and photos with lens distortion need (pip install pycolmap); "
            "where it has no wheel, as on Linux for Arm, convert and undistort the photos on another machine"
        )
    import pycolmap

    # The import makes glog answer SIGTERM with a stack dump. Python still reports its own handler, and setting that
    # again restores it.
    handler = signal.getsignal(signal.SIGTERM)
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)
    return pycolmap
