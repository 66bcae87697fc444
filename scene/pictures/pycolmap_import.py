"""The one place that imports pycolmap: late, and with what it does to the process undone."""

import signal
import threading
from types import ModuleType

# Pillow's zlib must be in the process before pycolmap's, or writing a PNG aborts (pycolmap 4.2.1, Pillow 13.0).
from PIL import Image  # noqa: F401


def import_pycolmap() -> ModuleType:
    """The module `pycolmap`. Late: importing it takes time and loads libraries that a Blender scene does not need."""
    import pycolmap

    # It lets glog answer SIGTERM with a stack dump. Python does not see that, so its own idea brings back what was.
    handler = signal.getsignal(signal.SIGTERM)
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)
    return pycolmap
