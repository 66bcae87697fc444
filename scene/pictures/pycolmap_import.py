"""Import of pycolmap, when it is first needed, with its side effects undone."""

import signal
import threading
from types import ModuleType

# Pillow's zlib must be in the process before pycolmap's, or writing a PNG aborts (pycolmap 4.2.1, Pillow 13.0).
from PIL import Image  # noqa: F401


def import_pycolmap() -> ModuleType:
    """The module `pycolmap`, whose import takes time and loads libraries that a Blender scene does not need."""
    import pycolmap

    # The import makes glog answer SIGTERM with a stack dump. Python still reports its own handler, and setting that
    # again restores it.
    handler = signal.getsignal(signal.SIGTERM)
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)
    return pycolmap
