"""Check of the counts and lengths in the binary files of a COLMAP model, which pycolmap trusts.

A count that is larger than its file makes pycolmap 4.2.1 fill all memory, or the missing part with garbage.
"""

import functools
import mmap
import struct
from collections.abc import Callable
from pathlib import Path

from scene.pictures.pycolmap_import import import_pycolmap

_U8, _U32, _U64 = struct.Struct("<B"), struct.Struct("<I"), struct.Struct("<Q")
_POSE = 7 * 8  # bytes of a quaternion and a translation
_SENSOR = 8  # of a sensor's kind and id
# Bytes before the part of a record whose length varies (COLMAP's documentation, "Output Format"), and of its items.
_CAMERA_HEAD, _IMAGE_HEAD = 24, 4 + _POSE + 4
_POINT_HEAD = 8 + 3 * 8 + 3 + 8
_POINT2D, _TRACK_ELEMENT = 24, 8


def check_lengths(folder: Path) -> None:
    """ValueError naming the first binary file of a model that ends before its counts say, and the place."""
    for name, skip in _FILES.items():
        path = folder / name
        if path.is_file() and path.stat().st_size:
            with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                _walk(data, name, skip)


def _walk(data: mmap.mmap, name: str, skip: Callable[[mmap.mmap, int], int]) -> None:
    """Step through the records, each of which `skip` passes by; struct.error: it begins or ends beyond the file."""
    count, passed, end = 0, 0, 8
    try:
        (count,) = _U64.unpack_from(data)
        while passed < count:
            end = skip(data, end)
            if end > len(data):
                raise struct.error
            passed += 1
    except struct.error:
        raise ValueError(
            f"{name} is cut short or damaged: its {len(data):,} bytes end in record {passed + 1:,} of {count:,}"
        ) from None


def _camera(data: mmap.mmap, at: int) -> int:
    (model,) = _U32.unpack_from(data, at + 4)
    parameters = _parameters().get(model)
    if parameters is None:
        raise ValueError(f"cameras.bin has a camera of model number {model}, which COLMAP does not have")
    return at + _CAMERA_HEAD + 8 * parameters


@functools.cache
def _parameters() -> dict[int, int]:
    """The number of parameters by the number of the camera model."""
    pycolmap = import_pycolmap()
    models = [model for model in pycolmap.CameraModelId.__members__.values() if int(model) >= 0]
    return {int(model): len(pycolmap.Camera.create_from_model_id(1, model, 1.0, 1, 1).params) for model in models}


def _image(data: mmap.mmap, at: int) -> int:
    name_end = data.find(b"\0", at + _IMAGE_HEAD)
    if name_end < 0:
        raise struct.error
    return name_end + 9 + _POINT2D * _U64.unpack_from(data, name_end + 1)[0]


def _point(data: mmap.mmap, at: int) -> int:
    return at + _POINT_HEAD + 8 + _TRACK_ELEMENT * _U64.unpack_from(data, at + _POINT_HEAD)[0]


def _rig(data: mmap.mmap, at: int) -> int:
    (sensors,) = _U32.unpack_from(data, at + 4)
    at += 8 + _SENSOR * (sensors > 0)
    for _ in range(sensors - 1):
        at += _SENSOR + 1 + _POSE * (_U8.unpack_from(data, at + _SENSOR)[0] != 0)
    return at


def _frame(data: mmap.mmap, at: int) -> int:
    head = 8 + _POSE
    return at + head + 4 + (_SENSOR + 8) * _U32.unpack_from(data, at + head)[0]


_FILES = {"cameras.bin": _camera, "images.bin": _image, "points3D.bin": _point, "rigs.bin": _rig, "frames.bin": _frame}
