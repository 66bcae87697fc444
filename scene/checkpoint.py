"""chkpntN.pth: (capture of the model, N), tensors and numbers only, read without running anything it holds."""

import contextlib
import os
from collections.abc import Iterator

import numpy as np
import torch

from utils.system_utils import UserError, atomic_write

_ENTRIES = 12  # of the reference; the values of further attributes may follow
# The reference stores the scene extent as a NumPy scalar. NumPy 1 and 2 name its rebuilding function differently.
_SCALAR = np.float64(0).__reduce__()[0]
_ALLOWED = [
    (_SCALAR, "numpy.core.multiarray.scalar"),
    (_SCALAR, "numpy._core.multiarray.scalar"),
    np.dtype,
    np.dtypes.Float32DType,
    np.dtypes.Float64DType,
]


def save_checkpoint(path: str | os.PathLike, capture: tuple, iteration: int) -> None:
    """Write (capture, iteration), whole or not at all."""
    with atomic_write(path) as temporary:
        torch.save((capture, iteration), temporary)


def load_checkpoint(path: str | os.PathLike, device: torch.device | str = "cpu") -> tuple[tuple, int]:
    """Read (capture, iteration), ours or the reference's. UserError, one sentence, for anything else."""
    _refuse_other_kinds(path)
    try:
        with torch.serialization.safe_globals(_ALLOWED):
            content = torch.load(path, map_location=device, weights_only=True)
    except Exception as error:  # a damaged file can end in any exception of the unpickler
        raise UserError(
            f"{path} is not a checkpoint of train.py: it is damaged, or holds objects other than tensors and numbers, "
            "which are never run; give a chkpntN.pth"
        ) from error
    with _as_user_error(path):
        capture, iteration = content
        per_gaussian = (*capture[1:10], *capture[_ENTRIES:])
        if len(capture) < _ENTRIES or not all(torch.is_tensor(entry) for entry in per_gaussian):
            raise ValueError
        count = len(capture[1])
        if any(len(tensor) != count for tensor in per_gaussian):
            raise ValueError
        return tuple(capture), int(iteration)


def _refuse_other_kinds(path: str | os.PathLike) -> None:
    """Name what people give by mistake: nothing, a model folder, a point cloud."""
    if os.path.isdir(path):
        raise UserError(f"--start_checkpoint {path} is a folder; give the file chkpntN.pth in it")
    if not os.path.isfile(path):
        raise UserError(f"no checkpoint {path}; train with --checkpoint_iterations to have one written")
    with open(path, "rb") as file:
        if file.read(4) in (b"ply\n", b"ply\r"):
            raise UserError(
                f"--start_checkpoint {path} is a PLY, which has no optimiser state to go on from; give a chkpntN.pth"
            )


@contextlib.contextmanager
def _as_user_error(path: str | os.PathLike) -> Iterator[None]:
    try:
        yield
    except (TypeError, ValueError) as error:
        raise UserError(f"{path} is not a checkpoint of train.py: its parts do not fit; give a chkpntN.pth") from error
