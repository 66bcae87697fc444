"""What --region may be, as text."""

import math

VALID = 'auto, a sphere "X Y Z RADIUS", or a box "X0 Y0 Z0 X1 Y1 Z1" with the smaller corner first'


def numbers_of(text: str) -> list[float] | None:
    """Four numbers of a sphere, or six of a box; None: they are to be found. ValueError for anything else."""
    if text == "auto":
        return None
    numbers = [float(word) for word in text.replace(",", " ").split()]
    sphere = len(numbers) == 4 and numbers[3] > 0
    box = len(numbers) == 6 and all(low < high for low, high in zip(numbers[:3], numbers[3:], strict=True))
    if not (all(map(math.isfinite, numbers)) and (sphere or box)):
        raise ValueError(f"must be {VALID}, got {text!r}")
    return numbers


def problem(text: str) -> str | None:
    """What --region may be, where it is something else; empty: no region."""
    try:
        return numbers_of(text) and None if text else None
    except ValueError:
        return VALID
