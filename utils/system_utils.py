"""Files, folders, user errors and exit statuses for every command line."""

import contextlib
import errno
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path

from groundwork.files.writing import atomic_write, check_folder_can_be_made, mkdir_p, temporary_folder, writes_files
from groundwork.host import start, torchrun
from groundwork.host.errors import UserError, first_line
from groundwork.host.interrupt import Terminated, let_signals_end
from groundwork.host.machine import compute_device, missing_code_message
from groundwork.host.memory import describe_shortage, is_out_of_memory

__all__ = [
    "Terminated",
    "UserError",
    "atomic_write",
    "check_folder_can_be_made",
    "compute_device",
    "find_iteration",
    "first_line",
    "mkdir_p",
    "run_cli",
    "saved_iterations",
    "saved_ply",
    "searchForMaxIteration",
    "temporary_folder",
    "writes_files",
]

_REFUSED = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT)  # by the system, for no fault of ours
_ITERATION_FOLDER = re.compile(r"iteration_(\d+)")


def run_cli(main: Callable[[], object], several: bool = False) -> None:
    """Run a command line: a UserError prints its sentence and exits 2; a bug keeps its traceback.

    several: whether processes of torchrun may run it together (groundwork/ranks/launcher.py); else they are refused.

    Signals exit as in shells: Ctrl-C 130, SIGTERM 143, and 141 if the reader of the output is gone (`| head`). An
    output that cannot be written (disk full) exits 2, and one that is closed does not matter. A file or folder that the
    system refuses exits 2.
    """
    start.after_imports()
    try:
        status = _run_alone(main) if torchrun.size() == 1 else _run_among_several(main, several)
        sys.stdout.flush()  # now, while a broken pipe can still be caught
    except BrokenPipeError:
        _discard_output()
        status = 141
    except OSError as error:
        status = 2
        if error.filename is not None and error.errno in _REFUSED:
            remedy = "fix its permissions, free space there, or choose another place"
            print(f"error: the system refuses {error.filename} ({error.strerror}); {remedy}", file=sys.stderr)
        elif error.filename is not None or not _is_output_broken():
            raise
        else:
            with contextlib.suppress(OSError):
                reason = f"cannot write to the standard output ({error.strerror})"
                print(f"error: {reason}; free space there, or send the output elsewhere", file=sys.stderr)
            _discard_output()
    finally:
        let_signals_end()  # else one that comes now would print a traceback from Python's own end
    if status:
        sys.exit(status)


def _is_output_broken() -> bool:
    """Tell whether the standard output cannot be written, as on a full disk, by writing a line end to it."""
    try:
        sys.stdout.flush()
        os.write(sys.__stdout__.fileno(), b"\n")
    except OSError:
        return True
    return False


def _discard_output() -> None:
    """Discard both streams: Python flushes them again when it exits, and either may be broken."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (sys.__stdout__, sys.__stderr__):
        os.dup2(nowhere, stream.fileno())


def _run_alone(main: Callable[[], object]) -> int:
    status, line = _run_command(main)
    if line:
        print(line, file=sys.stderr)
    return status


def _run_among_several(main: Callable[[], object], several: bool) -> int:
    """Run a command in one of torchrun's processes, and return its exit status. several: it may."""
    if not several:
        if torchrun.rank() == 0:
            print(f"error: {Path(sys.argv[0]).name} runs in one process; start it without torchrun", file=sys.stderr)
        return 2
    from groundwork.ranks.launcher import run_together  # it loads torch.distributed

    return run_together(main, _run_command)


def _run_command(main: Callable[[], object]) -> tuple[int, str]:
    """Run a command. Returns its exit status, and the message for stderr."""
    try:
        main()
    except UserError as error:
        return 2, f"error: {error}"
    except (MemoryError, RuntimeError) as error:
        if said := missing_code_message(error):
            return 2, f"error: {said}"
        if not is_out_of_memory(error):
            raise
        reason = f"error: ran out of memory ({describe_shortage(error, compute_device())})"
        return 2, f"{reason}; lower --resolution (-r), or free memory that other programs use"
    except Terminated:
        return 143, "terminated"
    except KeyboardInterrupt as error:
        return 130, str(error) or "interrupted"
    return 0, ""


def saved_iterations(folder: str | os.PathLike) -> list[int]:
    """List every N of the sub-folders `iteration_N`, ascending; empty if the folder is missing."""
    names = os.listdir(folder) if os.path.isdir(folder) else []
    return sorted(int(match[1]) for name in names if (match := _ITERATION_FOLDER.fullmatch(name)))


def searchForMaxIteration(folder: str | os.PathLike) -> int:
    """Largest N of the sub-folders `iteration_N`. UserError if there are none."""
    iterations = saved_iterations(folder)
    if not iterations:
        raise UserError(f"no saved iteration in {folder} (looked for folders iteration_N); train the model first")
    return iterations[-1]


def saved_ply(model_path: str | os.PathLike, iteration: int | str) -> Path:
    """The PLY of an iteration in a model folder."""
    return Path(model_path) / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"


def find_iteration(model_path: str | os.PathLike, iteration: int) -> int:
    """Resolve an iteration, -1: the last one saved. UserError if the model folder has no save of it."""
    folder = Path(model_path) / "point_cloud"
    last = searchForMaxIteration(folder)
    if iteration == -1:
        return last
    if not saved_ply(model_path, iteration).is_file():
        saved = ", ".join(map(str, saved_iterations(folder)))
        raise UserError(f"iteration {iteration} was never saved in {folder}; give one of {saved}")
    return iteration
