"""chkpntN.pth: (capture of the model, N), tensors and numbers only, read without running anything it holds."""

import math
import os
from numbers import Real
from typing import Any

import numpy as np
import torch

from utils.system_utils import UserError, atomic_write

_ENTRIES = 12  # of the reference; the values of further attributes may follow, and a dict of the exposures
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
        try:
            torch.save((capture, iteration), temporary)
        except RuntimeError as error:
            # torch hides why its writer of archives failed, but that is never the content.
            if "inline_container" not in str(error) and "PytorchStreamWriter" not in str(error):
                raise
            raise OSError("no space is left, or files must not be so large") from error


def load_checkpoint(path: str | os.PathLike, device: torch.device | str = "cpu") -> tuple[tuple, int]:
    """Read (capture, iteration), ours or the reference's. UserError, one sentence, for anything else."""
    _refuse_other_kinds(path)
    try:
        _refuse_other_formats(path)
        with torch.serialization.safe_globals(_ALLOWED):
            content = torch.load(path, map_location=device, weights_only=True)
    except Exception as error:  # a damaged file can end in any exception of the unpickler
        raise UserError(
            f"{path} is not a checkpoint of train.py: it is damaged, or holds objects other than tensors and numbers, "
            "which are never run; give a chkpntN.pth"
        ) from error
    try:
        return _checked(content)
    except ValueError as error:
        raise UserError(
            f"{path} is not a checkpoint of train.py: its parts do not fit ({error}); give a chkpntN.pth"
        ) from error


def _refuse_other_formats(path: str | os.PathLike) -> None:
    """ValueError for the formats before torch 1.6, whose reader believes any number of bytes that a file names."""
    with open(path, "rb") as file:
        if file.read(4) != b"PK\x03\x04":
            raise ValueError("no zip archive")


def _checked(content: Any) -> tuple[tuple, int]:
    """Capture and iteration; ValueError saying what is wrong. Shapes of attributes are GaussianModel.restore's."""
    if not isinstance(content, tuple | list) or len(content) != 2:
        raise ValueError("it is no pair of a state and an iteration")
    capture, iteration = content
    if not isinstance(capture, tuple | list) or len(capture) < _ENTRIES:
        raise ValueError(f"the state has not {_ENTRIES} entries")
    if type(iteration) is not int or not 0 <= iteration < 2**31:
        raise ValueError(f"the iteration is {iteration!r:.40}")
    if type(capture[0]) is not int or not 0 <= capture[0] <= 3:
        raise ValueError(f"the active SH degree is {capture[0]!r:.40}")
    per_gaussian = (*capture[1:10], *(entry for entry in capture[_ENTRIES:] if not isinstance(entry, dict)))
    if not all(torch.is_tensor(t) and t.dim() > 0 and t.dtype == torch.float32 for t in per_gaussian):
        raise ValueError("a value per Gaussian is not a float32 tensor")
    count = len(capture[1])
    if count == 0:
        raise ValueError("it has no Gaussians")
    if any(len(tensor) != count for tensor in per_gaussian):
        raise ValueError("tensors differ in the number of Gaussians")
    if [tuple(tensor.shape[1:]) for tensor in capture[7:10]] != [(), (1,), (1,)]:
        raise ValueError("the statistics of density control have other shapes")
    extent = capture[11]
    if not isinstance(extent, Real) or isinstance(extent, bool) or not 0 <= extent < math.inf:
        raise ValueError(f"the extent of the scene is {extent!r:.40}")
    return tuple(capture), iteration


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
