"""Training size of a picture (the reference's rules, rounding modes included)."""

import functools
import sys

from utils.system_utils import UserError

WIDEST = 1600
LARGEST = 16384  # pixels a side; beyond, a slip of the keyboard is likelier than a machine with memory for it


def training_size(width: int, height: int, resolution: int, scale: float = 1.0) -> tuple[int, int]:
    """Size (width, height) in pixels at which a file of the given size trains.

    resolution: option -r. 1, 2, 4, 8 divide and round half to even; -1 keeps up to 1600 pixels of width; any other
    value is the width. The last two truncate. scale: further factor by which it is made smaller. At least 1 pixel;
    UserError above LARGEST pixels a side.
    """
    if resolution > LARGEST:
        raise UserError(f"--resolution (-r) {resolution} is too wide; the most is {LARGEST} pixels")
    if resolution in (1, 2, 4, 8):
        size = round(width / (scale * resolution)), round(height / (scale * resolution))
    else:
        if resolution != -1:
            factor = width / resolution
        elif width > WIDEST:
            _notice()
            factor = width / WIDEST
        else:
            factor = 1.0
        size = int(width / (factor * scale)), int(height / (factor * scale))
    if max(size) > LARGEST:
        raise UserError(
            f"a picture of {width} x {height} pixels would train at {size[0]} x {size[1]} with --resolution (-r) "
            f"{resolution}, and the most is {LARGEST} a side; choose another"
        )
    return max(size[0], 1), max(size[1], 1)


@functools.cache
def _notice() -> None:
    # Cached: said once per process, not once per picture.
    print(f"pictures wider than {WIDEST} pixels are shrunk to that width; -r 1 keeps their size", file=sys.stderr)
