"""Splats, the form in which all formats are read and written; selections, and rotations to other axes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from utils.sh_utils import C0, sh_basis
from utils.system_utils import UserError

_LARGEST = 80.0  # of a logarithm of a scale; exp(89) is infinite in float32
_TOGETHER = 4096  # splats whose SH bands are turned at once: they fit into the processor's cache
_DIRECTIONS = 64  # more than the 25 coefficients that they determine
_AXES = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}
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


@dataclass(frozen=True)
class Splats:
    """N Gaussians on the CPU, float32, in the raw form of our PLY files.

    means (N,3); log_scales (N,3), natural logarithms; rotations (N,4), wxyz, of length 1; opacity_logits (N,);
    sh (N,K,3), the bands in the reference's order, K = (degree + 1)^2. Axes are those of COLMAP's world: of a usual
    capture x is right, y down, z forward. antialiasing: whether they were trained with --antialiasing. world_offset:
    the world's coordinates of the origin of the means. enlargement: of the model where it is drawn, 1 where a file does
    not say (scene/readers/tracks.py). place: latitude and longitude (degrees) and height (metres) of the origin of
    means whose x is east, y down and z north, in metres; empty: unknown.
    """

    means: np.ndarray
    log_scales: np.ndarray
    rotations: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    antialiasing: bool = False
    world_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    enlargement: float = 1.0
    place: tuple[float, ...] = ()

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        return round(self.sh.shape[1] ** 0.5) - 1


def selected(splats: Splats, which: np.ndarray) -> Splats:
    """The splats of a mask (N,) bool, or of indices in their order."""
    names = ("means", "log_scales", "rotations", "opacity_logits", "sh")
    return replace(splats, **{name: np.ascontiguousarray(getattr(splats, name)[which]) for name in names})


def with_sh_degree(splats: Splats, degree: int) -> Splats:
    """The splats without SH bands above a degree; they never get more bands than they have."""
    return replace(splats, sh=np.ascontiguousarray(splats.sh[:, : (degree + 1) ** 2]))


def used_sh_degree(splats: Splats) -> int:
    """The lowest degree above which every SH coefficient is zero."""
    bands = np.flatnonzero(splats.sh.any(axis=(0, 2)))
    return int(bands[-1] ** 0.5) if len(bands) else 0


def drawable(splats: Splats) -> np.ndarray:
    """(N,) bool: the splats that the rasterizer draws. Infinite logits are opacities 0 and 1, all else is finite."""
    tables = splats.means, splats.log_scales, splats.rotations, splats.sh.reshape(len(splats), 3 * splats.sh.shape[1])
    finite = [np.isfinite(table).all(axis=1) for table in tables]
    return np.logical_and.reduce([*finite, ~np.isnan(splats.opacity_logits)])


def within_box(splats: Splats, box: Sequence[float]) -> np.ndarray:
    """(N,) bool: the splats whose centre lies in a box x0 y0 z0 x1 y1 z1 of the means' frame."""
    low, high = np.asarray(box[:3]), np.asarray(box[3:])
    return ((splats.means >= low) & (splats.means <= high)).all(axis=1)


def choose(splats: Splats, crop: Sequence[float] | None, min_opacity: float) -> np.ndarray:
    """(N,) bool: the splats that are drawn, lie in the box, and have at least this opacity. UserError if none do."""
    keep = drawable(splats) & (opacities(splats) >= min_opacity)
    if crop is not None:
        keep &= within_box(splats, crop)
    if len(splats) and not keep.any():
        raise UserError("no Gaussian is left; give a larger --crop or a smaller --min_opacity")
    return keep


def tidy(splats: Splats) -> Splats:
    """The splats with values that every format can hold: rotations of length 1, logs of finite scales of at most 80."""
    lengths = np.linalg.norm(splats.rotations, axis=1, keepdims=True)
    sound = lengths > 1e-12
    rotations = np.where(sound, splats.rotations / np.where(sound, lengths, 1), np.float32([1, 0, 0, 0]))
    scales = np.where(np.isposinf(splats.log_scales), np.inf, np.clip(splats.log_scales, -_LARGEST, _LARGEST))
    return replace(splats, rotations=rotations.astype(np.float32), log_scales=scales.astype(np.float32))


def half_rotated(splats: Splats) -> Splats:
    """The splats turned by half a turn about x, from COLMAP's axes to OpenGL's (x right, y up, z back), or back.

    The turn is a rotation, so shapes and colours stay the same.
    """
    return replace(
        splats,
        means=splats.means * np.float32([1, -1, -1]),
        rotations=splats.rotations * np.float32([1, 1, -1, -1]),
        sh=splats.sh * SH_SIGNS[: splats.sh.shape[1], None],
    )


def from_axes(splats: Splats, axes: str) -> Splats:
    """Splats whose x, y and z point as three letters say: right, left, down, up, forward (F) or back; in our axes.

    A world of left-handed axes is a mirror image of ours. A Gaussian keeps its shape if all is mirrored at its middle,
    which changes the sign of odd SH bands; what is left is a rotation.
    """
    turn = np.array([_AXES[axis] for axis in axes], np.float64).T
    if np.linalg.det(turn) < 0:
        odd = np.floor(np.sqrt(np.arange(splats.sh.shape[1]))) % 2 == 1
        splats = replace(splats, means=-splats.means, sh=np.where(odd[:, None], -splats.sh, splats.sh))
        turn = -turn
    return rotated(splats, turn)


def rotated(splats: Splats, turn: np.ndarray) -> Splats:
    """The same Gaussians in a world that is rotated (3,3); its offset is not kept."""
    from scipy.spatial.transform import Rotation  # it takes a while to import

    rotation = Rotation.from_matrix(turn) * Rotation.from_quat(splats.rotations, scalar_first=True)
    return replace(
        splats,
        means=(splats.means @ turn.T).astype(np.float32),
        rotations=rotation.as_quat(scalar_first=True).astype(np.float32),
        sh=_rotate_sh(splats.sh, _make_sh_rotation(splats.sh_degree, turn).astype(np.float32)),
        world_offset=(0.0, 0.0, 0.0),
    )


def _rotate_sh(sh: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """The coefficients (N,K,3) times a matrix (K,K), float32."""
    turned = np.empty_like(sh)
    for first in range(0, len(sh), _TOGETHER):
        some = np.moveaxis(sh[first : first + _TOGETHER], 0, -1)  # splats last: seven times as fast
        product = np.einsum("jk,km->jm", matrix, np.ascontiguousarray(some).reshape(len(matrix), -1))
        turned[first : first + _TOGETHER] = np.moveaxis(product.reshape(some.shape), -1, 0)
    return turned


def _make_sh_rotation(degree: int, turn: np.ndarray) -> np.ndarray:
    """The matrix (K,K) of SH coefficients: the new function at a direction d is the old one at turn^T d."""
    directions = torch.randn(_DIRECTIONS, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    directions = torch.nn.functional.normalize(directions)
    new, old = sh_basis(degree, directions), sh_basis(degree, directions @ torch.from_numpy(turn))
    return torch.linalg.lstsq(new, old).solution.numpy()


def base_colors(splats: Splats) -> np.ndarray:
    """RGB (N,3) float32 of SH band 0; [0, 1] is what can be shown."""
    return splats.sh[:, 0] * C0 + 0.5


def opacities(splats: Splats) -> np.ndarray:
    """Opacities (N,) float64 in [0, 1]."""
    return 1 / (1 + np.exp(-np.clip(splats.opacity_logits.astype(np.float64), -700, 700)))


def logits(values: np.ndarray, step: float) -> np.ndarray:
    """Logits (float32) of opacities in [0, 1] that were rounded to multiples of `step`.

    0 and 1 become a quarter of a step away, so that they are finite.
    """
    inner = np.clip(np.asarray(values, np.float64), step / 4, 1 - step / 4)
    return np.log(inner / (1 - inner)).astype(np.float32)
