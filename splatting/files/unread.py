"""What a file has and no reader uses, told in one line: fields, columns and records of other programs."""

import os
import sys
from collections.abc import Iterable
from typing import NamedTuple


class Form(NamedTuple):
    """What the parts of a kind of file are called, and the names of those that change no result."""

    parts: str
    harmless: frozenset[str]


_METASHAPE = (
    "bands black_level camera_ids covariance data_type frames layer_index location_covariance markers meta orientation "
    "partition photo property reference region rotation_covariance scalebars sensitivity settings shapes vignetting"
)
# By the name of the kind of file.
FORMS = {
    "transforms": Form("fields", frozenset()),
    "frames": Form("fields of the frames", frozenset()),  # of transforms.json
    "ply": Form("columns", frozenset()),
    "spz": Form("records", frozenset()),
    "metashape": Form("elements", frozenset(_METASHAPE.split())),
    "colmap": Form("files", frozenset()),
}
_TOLD = 3  # names


def say_unread(path: str | os.PathLike, form: str, names: Iterable[str]) -> None:
    """Name at most three parts of a file that its reader does not use, but for those that are harmless.

    form: a key of FORMS. names: of all parts that the reader passes over; without one, nothing is said.
    """
    parts, harmless = FORMS[form]
    if left := sorted(set(names) - harmless):
        more = f" and {len(left) - _TOLD} more" if len(left) > _TOLD else ""
        print(f"{parts} of {path} that are not used: {', '.join(left[:_TOLD])}{more}", file=sys.stderr)
