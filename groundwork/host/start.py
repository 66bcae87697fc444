"""Start of a command: signals, garbage, outputs, kept memory and the GPU's context, before its imports.

Importing torch makes half a million objects that stay. Python's collector would go through them several times meanwhile
and once more at the end, which takes a third of the seconds of a process that does nothing else.
"""

import ctypes
import gc
import importlib.util
import io
import os
import re
import shlex
import signal
import sys
import threading
from pathlib import Path
from typing import Any

from groundwork.host import torchrun
from groundwork.host.interrupt import raise_on_signals
from groundwork.host.programs import find_program, forget_relative_path

_TRIM, _SEPARATE = -1, -3  # M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of mallopt
_KEPT = 256 << 20  # bytes that may lie free
_LARGE = 32 << 20  # bytes of an allocation that is given back as soon as it is freed; glibc allows no more
_ROOT = Path(__file__).resolve().parents[2]
_DRIVER = "libcuda.so.1"
_waiting = False  # whether the collector is


def prepare() -> None:
    """Call before a command's imports, which take a second: Ctrl-C then ends it at once, without a traceback.

    Python raises KeyboardInterrupt inside whatever is being imported, and some packages swallow it. A SIGINT that is
    ignored, as in the background of a shell, stays ignored.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    global _waiting
    _waiting = gc.isenabled()
    gc.disable()
    open_outputs()
    keep_freed_memory()
    sys.excepthook = _end_by_misfit


def _end_by_misfit(kind: type[BaseException], error: BaseException, trace: Any) -> None:
    """Print one sentence, and exit 2, where an extension lacks what this checkout needs; else print the traceback."""
    is_import = isinstance(error, ImportError) and re.search("diff_gaussian|fused_ssim|simple_knn", str(error))
    if not is_import and not hasattr(getattr(error, "obj", None), "rasterize"):  # the rasterizer, or its operators
        return sys.__excepthook__(kind, error, trace)
    said = str(error) if is_import else f"the rasterizer has no {error.name}"
    if "`pip install" not in said:
        said += ", as the extensions do not fit this checkout; run `make install` or `pip install .` in the repository"
    print(f"error: {said}", file=sys.stderr)
    sys.exit(2)


def after_imports() -> None:
    """Call after a command's imports: signals raise exceptions, and garbage is collected, imported objects left out.

    Programs are no longer looked for in the current folder.

    Without `prepare`, as where other code calls this, its garbage is its own.
    """
    forget_relative_path()
    global _waiting
    if _waiting:
        gc.freeze()
        gc.enable()
        _waiting = False
    if "numpy" in sys.modules:
        import numpy.random  # noqa: F401  (or numpy would import it later, and might swallow a signal)
    if threading.current_thread() is threading.main_thread():
        if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        raise_on_signals()
    open_outputs()


def open_outputs() -> None:
    """Discard what is written to a closed output (`>&-`), and let an output write the number of a letter it lacks."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            nowhere = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115  (open to the end)
            setattr(sys, name, nowhere)
            setattr(sys, f"__{name}__", nowhere)
        elif isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")


def keep_freed_memory() -> None:
    """Keep freed memory for the next allocation; by default glibc returns it to the system.

    A step on the CPU frees as much memory as the next one takes, which the system would have to clear again: up to a
    tenth of a training (docs/inside/notebook.md). Nothing changes without glibc, or where the environment sets limits.
    """
    if any(name.startswith("MALLOC_") or name == "GLIBC_TUNABLES" for name in os.environ):
        return
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return
    mallopt(_SEPARATE, _LARGE)
    mallopt(_TRIM, _KEPT)


def begin_cuda() -> threading.Thread | None:
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
    """Tell whether the rasterizer was built with CUDA kernels; its library then uses torch's streams."""
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


def typed_command(script: str) -> str:
    """The command line of a script, or of `-m MODULE`, as typed in the current folder, with this Python.

    The latter is called python, if that is it.
    """
    found, own = find_program("python"), Path(sys.executable)
    python = "python" if found and Path(found).absolute() == own.absolute() else _quote_path(own)
    if script.startswith("-m "):
        place = "" if Path.cwd() == _ROOT else f"PYTHONPATH={_quote_path(_ROOT)} "
        return f"{place}{python} {script}"
    return f"{python} {_quote_path(_ROOT / script)}"


def _quote_path(path: Path) -> str:
    here = Path.cwd()
    return shlex.quote(str(path.relative_to(here) if here in path.parents and here != here.parent else path))
