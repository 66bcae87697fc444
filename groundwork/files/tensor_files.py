"""Files that torch.save has written: tensors and plain values, read without torch's unpickler.

torch's safe loader lets a file choose how much memory it takes, and calls methods of the allowed types. Here a file can
make only values of Machine, plain tensors over bytes that the file holds, and floats that NumPy has written.
"""

import contextlib
import io
import math
import os
import struct
import sys
import zipfile
from collections.abc import Callable
from typing import Any, BinaryIO, NamedTuple

import torch

from groundwork.files.plain_files import plain_path
from groundwork.files.plain_pickle import MOST_BYTES, Machine, plain_dict
from groundwork.host.errors import UserError

_MAGIC, _PROTOCOL = 0x1950A86A20F9469CFC6C, 1001  # of the format before torch 1.6
_ZIP = b"PK\x03\x04"
_MOST_PARTS = 10_000  # of an archive; each storage is one
_ALIGNMENT = 64  # bytes; torch's, for tensors that stay in the file
_DTYPES = {
    "Float": torch.float32, "Double": torch.float64, "Half": torch.float16, "BFloat16": torch.bfloat16,
    "Long": torch.int64, "Int": torch.int32, "Short": torch.int16, "Char": torch.int8, "Byte": torch.uint8,
    "Bool": torch.bool,
}  # fmt: skip


class _Storage(NamedTuple):
    dtype: torch.dtype
    bytes: torch.UntypedStorage


class _Format:
    """A float of NumPy, float32 or float64."""

    def __init__(self, code: str) -> None:
        self.code = code


def read_tensors(path: str | os.PathLike, *, mapped: bool = False, legacy: bool = False) -> Any:
    """The content of a file: plain values, Tensors and Parameters, on the CPU.

    mapped: tensors stay in the file until a part of them is read.
    legacy: also take the format before torch 1.6.

    OSError for a file that cannot be opened, UserError for wrong checksums, ValueError for anything else that
    torch.save has not written, or that holds other objects. No message quotes the file.
    """
    with open(plain_path(path), "rb") as file:
        try:
            if file.read(len(_ZIP)) == _ZIP:
                return _read_archive(file, mapped)
            if not legacy:
                raise ValueError("another kind of file")
            return _read_legacy(file)
        except UserError:
            raise
        except Exception as error:  # a damaged file can raise any exception
            raise ValueError(
                "it is damaged, or holds objects other than whole tensors, numbers and text, which are never run"
            ) from error


def _read_archive(file: BinaryIO, mapped: bool) -> Any:
    """Read a zip archive of torch.save. mapped: tensors stay in the file. ValueError for another archive."""
    size = os.fstat(file.fileno()).st_size
    with zipfile.ZipFile(file) as archive:
        parts = archive.infolist()
        # torch stores parts as they are; compressed or overlapping ones could be larger than any memory.
        stored = all(p.compress_type == zipfile.ZIP_STORED and p.file_size == p.compress_size for p in parts)
        if not stored or len(parts) > _MOST_PARTS or sum(part.file_size for part in parts) > size:
            raise ValueError("parts that torch does not write")
        if archive.testzip():
            raise UserError(
                f"{file.name} is damaged: a part of it does not have the checksum it was saved with; copy the file "
                "again, or give another one"
            )
        folder = parts[0].filename.partition("/")[0]
        with contextlib.suppress(KeyError):
            if archive.read(f"{folder}/byteorder") != sys.byteorder.encode():
                raise ValueError("written by another kind of machine")
        whole = torch.UntypedStorage.from_file(os.fspath(file.name), False, size) if mapped else None

        def stored_bytes(key: str, nbytes: int, _: int) -> torch.UntypedStorage:
            """Return the storage of a key, mapped from the file where its alignment allows that."""
            part = archive.getinfo(f"{folder}/data/{key}")
            if part.file_size != nbytes:
                raise ValueError("a storage of another size")
            file.seek(part.header_offset)
            start = part.header_offset + 30 + sum(struct.unpack("<26xHH", file.read(30)))  # name and padding
            if whole is not None and start % _ALIGNMENT == 0:
                return whole[start : start + nbytes]
            file.seek(start)
            return _fill_storage(torch.UntypedStorage(nbytes), file)

        pickle = archive.getinfo(f"{folder}/data.pkl")
        if pickle.file_size > MOST_BYTES:
            raise ValueError("too long")
        return _make_machine(stored_bytes).read(io.BytesIO(archive.read(pickle)))


def _read_legacy(file: BinaryIO) -> Any:
    """Read several pickles; the last one lists the storages, whose bytes follow it."""
    left = os.fstat(file.fileno()).st_size
    storages: dict[str, tuple[torch.UntypedStorage, int]] = {}

    def later_filled(key: str, nbytes: int, itemsize: int) -> torch.UntypedStorage:
        """Return an empty storage of a key, which is filled after the pickle is read."""
        nonlocal left
        left -= nbytes
        if left < 0:
            raise ValueError("storages larger than the file")
        storages[key] = torch.UntypedStorage(nbytes), nbytes // itemsize
        return storages[key][0]

    file.seek(0)
    head = io.BytesIO(file.read(MOST_BYTES))
    machine = _make_machine(later_filled)
    magic, protocol, _ = machine.read(head), machine.read(head), machine.read(head)
    if type(magic) is not int or (magic, protocol) != (_MAGIC, _PROTOCOL):
        raise ValueError("another kind of file")
    content = machine.read(head)
    keys = machine.read(head)
    file.seek(head.tell())
    if type(keys) is not list or any(type(key) is not str for key in keys):
        raise TypeError("keys of wrong types")
    for key in keys:
        storage, count = storages.pop(key)
        if struct.unpack("<q", file.read(8)) != (count,):
            raise ValueError("a storage of another size")
        _fill_storage(storage, file)
    if storages:
        raise ValueError("storages without values")
    return content


def _fill_storage(storage: torch.UntypedStorage, file: BinaryIO) -> torch.UntypedStorage:
    """Fill a storage from a file, and return it. EOFError if the file ends before."""
    if storage.nbytes():
        values = torch.empty(0, dtype=torch.uint8, device="cpu").set_(storage).numpy()
        if file.readinto(values) != len(values):
            raise EOFError("too short")
    return storage


def _make_machine(stored: Callable[[str, int, int], torch.UntypedStorage]) -> Machine:
    """Make a machine for the names that torch.save writes. stored: returns a storage for a key, bytes and item size."""
    known: dict[str, torch.UntypedStorage] = {}

    def storage(identity: Any) -> _Storage:
        """Return the typed storage that a persistent id of torch.save names; each key is read once."""
        if type(identity) is not tuple:
            raise TypeError("a persistent id that torch does not write")
        word, dtype, key, _, count, *view = identity
        if [type(value) for value in (word, dtype, key, count)] != [str, torch.dtype, str, int]:
            raise TypeError("a persistent id of wrong types")
        nbytes = count * dtype.itemsize
        if word != "storage" or not 0 <= nbytes < 2**63 or any(part is not None for part in view):
            raise ValueError("a persistent id that torch does not write")
        if key not in known:
            known[key] = stored(key, nbytes, dtype.itemsize)
        if known[key].nbytes() != nbytes:
            raise ValueError("a storage of two sizes")
        return _Storage(dtype, known[key])

    return Machine(_NAMES, storage, _build, (torch.Tensor, torch.nn.Parameter))


def _make_tensor(
    storage: Any, offset: Any, size: Any, stride: Any, requires_grad: Any = False, _: Any = None
) -> torch.Tensor:
    """Make a tensor; it must lie within its storage and claim no more values than are stored."""
    if [type(value) for value in (storage, size, stride, requires_grad)] != [_Storage, tuple, tuple, bool]:
        raise TypeError("a tensor of wrong types")
    numbers = (offset, *size, *stride)
    if len(size) != len(stride) or len(size) > 8 or any(type(n) is not int or not 0 <= n < 2**48 for n in numbers):
        raise ValueError("a tensor of odd numbers")
    stored = storage.bytes.nbytes() // storage.dtype.itemsize
    claimed = math.prod(size)
    reached = offset + (sum((n - 1) * step for n, step in zip(size, stride, strict=True)) + 1 if claimed else 0)
    if max(claimed, reached) > stored or math.prod(max(n, 1) for n in size) >= 2**60:
        raise ValueError("a tensor beyond its storage")
    empty = torch.empty(0, dtype=storage.dtype, device=storage.bytes.device)
    return empty.set_(storage.bytes, offset, size, stride).requires_grad_(requires_grad)


def _make_parameter(data: Any, requires_grad: Any = True, _: Any = None) -> torch.nn.Parameter:
    if type(data) is not torch.Tensor or type(requires_grad) is not bool:
        raise TypeError("a parameter of wrong types")
    return torch.nn.Parameter(data, requires_grad)


def _make_ordered_dict(pairs: Any = ()) -> dict[str | int, Any]:
    return plain_dict(pairs)


def _encode(text: Any, encoding: Any) -> bytes:
    """Make bytes, which protocol 2 writes as text and an encoding."""
    if type(text) is not str or type(encoding) is not str or encoding != "latin1":
        raise TypeError("bytes of wrong types")
    return text.encode("latin1")


def _make_dtype(code: Any, *_: Any) -> _Format:
    if type(code) is not str or code not in ("f4", "f8"):
        raise TypeError("a dtype of NumPy other than float32 and float64")
    return _Format(code)


def _make_scalar(kind: Any, data: Any) -> float:
    if type(kind) is not _Format or type(data) is not bytes:
        raise TypeError("a scalar of wrong types")
    return struct.unpack({"f4": "<f", "f8": "<d"}[kind.code], data)[0]


def _build(value: Any, state: Any) -> None:
    """Apply a state to a Parameter of torch 0.1; accept one for another object only if it changes nothing."""
    if type(value) is torch.nn.Parameter and type(state) is tuple:
        requires_grad = state[-2 if len(state) == 5 else 0]
        if type(requires_grad) is not bool:
            raise TypeError("a state of wrong types")
        value.requires_grad_(requires_grad)
    elif type(value) is _Format:
        if type(state) is not tuple or type(state[1]) is not str or state[1] != "<":
            raise TypeError("a dtype of NumPy with another byte order")
    elif type(value) is not dict:  # state dicts have versions of their modules, which nobody asks for
        raise TypeError("a state for something else")


_NAMES = {
    **{f"torch {name}Storage": dtype for name, dtype in _DTYPES.items()},
    "torch._utils _rebuild_tensor": _make_tensor,
    "torch._utils _rebuild_tensor_v2": _make_tensor,
    "torch._utils _rebuild_parameter": _make_parameter,
    "torch.nn.parameter Parameter": _make_parameter,
    "collections OrderedDict": _make_ordered_dict,
    "_codecs encode": _encode,
    "numpy dtype": _make_dtype,
    "numpy.core.multiarray scalar": _make_scalar,
    "numpy._core.multiarray scalar": _make_scalar,
}
