"""Random damage, drawn from a random.Random: to bytes, to lines of text, to nested values."""

import math
import random
import struct
from typing import Any

_DOUBLES = (0.0, -0.0, 1.0, -1.0, 1e-300, 5e-324, 1e20, 1e39, -1e300, 1e308, math.inf, -math.inf, math.nan)
_INTEGERS = (0, 1, 2, 255, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63, 2**64 - 1)
_WORDS = ("-1", "0", "1e999", "nan", "inf", "-inf", "9999999999999", "9" * 23, "2147483648", "x", "", "1e-320", "1e39")
_SCALARS = (
    *(None, True, False, 0, 1, -1, 2**31, 2**63, 10**400, 0.5, 1e30, 1e39, -1e300, math.nan, math.inf),
    *("", "..", "/", "\0", "x" * 5000, "./train/r_0", "\ud800", "train", "1", [], {}, [[1, 2], [3, 4]], [0] * 16),
)


def damaged(rng: random.Random, whole: bytes, most: int = 3) -> bytes:
    """The bytes of a file with one to `most` damages."""
    data = bytearray(whole)
    for _ in range(rng.randint(1, most)):
        _damage_once(rng, data)
    return bytes(data)


def _damage_once(rng: random.Random, data: bytearray) -> None:
    start, length = rng.randint(0, len(data)), rng.choice((1, 2, 4, 8, 24, 64))
    kind = rng.choice(("bit", "bit", "replace", "number", "number", "cut", "drop", "double", "zero"))
    if kind == "bit" and start < len(data):
        data[start] ^= 1 << rng.randrange(8)
    elif kind == "replace":
        data[start : start + length] = rng.randbytes(length)
    elif kind == "number":
        new = rng.choice([struct.pack("<d", rng.choice(_DOUBLES)), struct.pack("<Q", rng.choice(_INTEGERS))])
        new = rng.choice([new, new[:4], struct.pack("<f", rng.choice((0.0, 1e30, math.nan, math.inf)))])
        data[start : start + len(new)] = new
    elif kind == "cut":
        del data[start:]
    elif kind == "drop":
        del data[start : start + length]
    elif kind == "double":
        data[start:start] = data[start : start + length]
    else:
        data[start : start + length] = bytes(min(length, len(data) - start))


def damaged_text(rng: random.Random, whole: str, most: int = 3) -> str:
    """A text with one to `most` words changed, missing or doubled, or lines missing."""
    lines = whole.split("\n")
    for _ in range(rng.randint(1, most)):
        row = rng.randrange(len(lines))
        words = lines[row].split(" ")
        place = rng.randrange(len(words))
        kind = rng.choice(("word", "word", "word", "drop", "double", "cut", "line"))
        if kind == "word":
            words[place] = rng.choice(_WORDS)
        elif kind == "drop":
            del words[place]
        elif kind == "double":
            words.insert(place, words[place])
        elif kind == "cut":
            words[place] = words[place][: rng.randint(0, len(words[place]))]
        lines[row] = " ".join(words)
        if kind == "line" and len(lines) > 1:
            del lines[row]
    return "\n".join(lines)


def changed(rng: random.Random, content: Any, values: tuple = _SCALARS, most: int = 3) -> Any:
    """A copy of nested lists, tuples and dicts with one to `most` entries changed or missing."""
    for _ in range(rng.randint(1, most)):
        content = _change_one(rng, content, values)
    return content


def _change_one(rng: random.Random, node: Any, values: tuple) -> Any:
    if not isinstance(node, dict | list | tuple) or not node or rng.randrange(8) == 0:
        if isinstance(node, float) and rng.random() < 0.3:
            return node * rng.choice((-1, 0, 10, 1e-6, 1e6, 1e30, 1e300))
        return rng.choice(values)
    keys = list(node) if isinstance(node, dict) else list(range(len(node)))
    key = rng.choice(keys)
    copy = dict(node) if isinstance(node, dict) else list(node)
    if rng.randrange(8) == 0:
        del copy[key]
    else:
        copy[key] = _change_one(rng, node[key], values)
    return tuple(copy) if isinstance(node, tuple) else copy
