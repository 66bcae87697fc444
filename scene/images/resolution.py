"""Training size of a photo, by the reference's rules and with its rounding."""

import functools
import sys

from utils.system_utils import UserError

WIDEST = 1600
LARGEST = 16384  # pixels a side; a larger -r is more likely a typing error than a plan for a machine with that memory


def training_size(width: int, height: int, resolution: int, scale: float = 1.0) -> tuple[int, int]:
    """Size (width, height) in pixels at which a photo of the given file size trains, at least 1 x 1.

    resolution: option -r. 1, 2, 4 and 8 divide, rounding half to even. -1 limits the width to 1600 pixels, any other
    value is the width; both truncate. scale: divides the size further. UserError above LARGEST pixels a side.
    """
    if resolution > LARGEST:
        raise UserError(f"--resolution (-r) {resolution} is too wide; give at most {LARGEST} pixels")
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
            f"a photo of {width} x {height} pixels would train at {size[0]} x {size[1]} with --resolution (-r) "
            f"{resolution}, but at most {LARGEST} a side are allowed; choose another resolution"
        )
    return max(size[0], 1), max(size[1], 1)


@functools.cache
def _notice() -> None:
    # Cached: printed once per process, not once per photo.
    print(f"photos wider than {WIDEST} pixels are shrunk to that width; -r 1 keeps their size", file=sys.stderr)
