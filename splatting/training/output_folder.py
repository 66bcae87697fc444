"""The output folder of a training: its default, and keeping it while the training runs."""

import contextlib
import os
import shlex
import sys
from collections.abc import Iterator
from itertools import count
from pathlib import Path

from scene.saved_model import saves_in
from splatting.distributed.ranks import ranks
from splatting.files.folders import locked, remove_temporary_files
from splatting.host.listing import some
from splatting.host.start import typed_command
from utils.system_utils import atomic_write, mkdir_p

_RECORDS = ("cfg_args", "model.json", "cameras.json", "train_log.json", "error_vs_time.csv", "schedule.json")
_INPUTS = ("cfg_args", "model.json", "cameras.json", "input.ply")


def new_folder(scene: str = "") -> str:
    """Name of a folder under ./output: OAR_JOB_ID as in the reference, else a new one after the folder of the scene."""
    if job := os.environ.get("OAR_JOB_ID"):
        return os.path.join("./output/", ranks().shared(job)[:10])
    name = os.path.join("./output/", os.path.basename(os.path.realpath(scene)) or "model")
    names = (f"{name}_{number}" if number > 1 else name for number in count(1))
    return ranks().shared(next(new for new in names if not os.path.exists(new)))


def folder_of(checkpoint: str | None) -> str | None:
    """The model folder that a checkpoint lies in, where a resumed training goes on unless another one is named."""
    folder = Path(checkpoint or "").parent
    return str(folder) if checkpoint and (folder / "cfg_args").is_file() else None


def view_command(model_path: str, iteration: int | None = None) -> str:
    """The command that shows a model; iteration: None, the newest one."""
    older = iteration is not None and max(saves_in(Path(model_path)), default=iteration) > iteration
    which = f" --iteration {iteration}" if older else ""
    return f"{typed_command('view.py')} -m {shlex.quote(model_path)}{which}"


@contextlib.contextmanager
def records_kept(model_path: str) -> Iterator[None]:
    """Put the records of a saved model back, if an error ends a training of its folder before that has saved another.

    A photo that cannot be read, for one, is found when it is needed. Of several ranks, the first does so for all.
    """
    folder = Path(model_path)
    saves = _stamps(folder) if ranks().first else {}
    kept = {name: (folder / name).read_bytes() for name in _RECORDS if saves and (folder / name).is_file()}
    try:
        yield
    except BaseException:
        if kept and _stamps(folder) == saves:
            for name, content in kept.items():
                with atomic_write(folder / name) as temporary:
                    temporary.write_bytes(content)
        raise


def _stamps(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in saves_in(folder).values()}


@contextlib.contextmanager
def own_folder(model_path: str) -> Iterator[None]:
    """Make the folder and keep it for this training. UserError if another train.py is at work in it.

    Temporary files of killed runs are removed first. A message says if files of the run are missing at the end, as
    when the folder was removed meanwhile. Of several ranks, the first does so for all.
    """
    if not ranks().first:
        yield
        return
    folder = Path(model_path)
    mkdir_p(folder)
    with locked(folder, "train.py", "another train.py (process {process})", "-m"):
        remove_temporary_files(folder)
        yield
        missing = [name for name in _INPUTS if not (folder / name).exists()]
        if missing not in ([], ["input.ply"]):  # a run that is resumed may have begun without the latter
            print(
                f"warning: {some(missing)} in {folder} were removed during training; the model is saved, but other "
                "programs may need them",
                file=sys.stderr,
            )
