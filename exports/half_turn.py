"""Half a turn about x, between COLMAP's axes (right, down, forward) and those of OpenGL (right, up, back).

Formats that have x to the right, y up and z back take splats turned like this; the same turn leads back.
"""

from dataclasses import replace

import numpy as np

from exports.splats import Splats

# Sign of each SH coefficient under y -> -y, z -> -z: each basis function is a polynomial of x y z, in the order of
# utils/sh_utils.py.
SH_SIGNS = np.float32(
    [
        1,
        *(-1, -1, 1),  # y, z, x
        *(-1, 1, 1, -1, 1),  # xy, yz, 2zz-xx-yy, xz, xx-yy
        *(-1, 1, -1, -1, 1, -1, 1),  # y(3xx-yy), xyz, y(4zz-xx-yy), z(...), x(4zz-xx-yy), z(xx-yy), x(xx-3yy)
    ]
)


def half_turned(splats: Splats) -> Splats:
    """The splats in axes with y and z reversed. The turn is a rotation, so shapes and colours stay the same."""
    return replace(
        splats,
        means=splats.means * np.float32([1, -1, -1]),
        rotations=splats.rotations * np.float32([1, 1, -1, -1]),
        sh=splats.sh * SH_SIGNS[: splats.sh.shape[1], None],
    )
