"""Start of the GPU's driver and context, which take a second, while the program imports its modules."""

import ctypes
import importlib.util
import threading
from pathlib import Path

from splatting.host import torchrun

_DRIVER = "libcuda.so.1"


def begin() -> threading.Thread | None:
    """Make the context that torch will find there, in a thread; None if this installation computes on the CPU.

    The driver's calls leave Python's lock to the imports. Without a driver or a GPU nothing happens, and torch says
    what there is to say. The program ends after the thread.
    """
    if not _computes_on_a_gpu():
        return None
    thread = threading.Thread(target=_make_context, name="cuda start")
    thread.start()
    return thread


def _computes_on_a_gpu() -> bool:
    """Whether the rasterizer was built with CUDA kernels: its library then asks torch for a stream."""
    found = importlib.util.find_spec("diff_gaussian_rasterization")
    library = found and found.origin and Path(found.origin).with_name("_backend.so")
    try:
        return bool(library) and b"aoti_torch_get_current_cuda_stream" in library.read_bytes()
    except OSError:
        return False


def _make_context() -> None:
    """Retain the primary context of the visible GPU that torch will compute on."""
    try:
        driver = ctypes.CDLL(_DRIVER)
        device, context = ctypes.c_int(), ctypes.c_void_p()
        if driver.cuInit(0) == 0 and driver.cuDeviceGet(ctypes.byref(device), torchrun.local_rank()) == 0:
            driver.cuDevicePrimaryCtxRetain(ctypes.byref(context), device)
    except (OSError, AttributeError):  # no driver, or another one of that name
        pass
