"""Corrections of a lens by 15 numbers (--refine_lens), and what its pixels say of them.

A focal length f becomes f / (1 - q), and the principal point moves by s of the new one; coefficients add up. So the
ray of a pinhole's pixel, (pixel - center) / f, becomes ray (1 - q) - s. None of the numbers has a unit. A fisheye has
the numbers of its chart (scene/readers/tracks.py) in place of a pinhole's rays.
"""

import numpy as np
import torch
from diff_gaussian_rasterization.lens import LENS_VALUES, Lens
from diff_gaussian_rasterization.reference.lens import pixels_of

from scene.readers.info import CameraInfo

ENDS = 2, 4, LENS_VALUES  # of focal lengths, principal point and coefficients
_FOCAL, _AXIS, _MEAN_FOCAL = 19, 21, 23  # places among a camera's numbers (csrc/math/camera_gradient.h)
_STEP = 1e-6  # of differences: 1e-3 pixels


def lens_of(view: CameraInfo) -> Lens:
    """The lens of a view's photo, which may be a pinhole."""
    return view.native or Lens("perspective", (view.fx, view.fy), (view.cx - 0.5, view.cy - 0.5))


def shares_of(view: CameraInfo) -> np.ndarray:
    """Values (15,) of a view's lens: `Lens.values` in parts of the photo's width and height, pixel centres at .5."""
    across = np.array([view.fx, view.fy, view.cx, view.cy]) / ((view.width, view.height) * 2)
    return np.array([*across, *lens_of(view).values[4:]])


def corrected(values: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Values (15,) of a lens, in pixels or parts of the image, after a change (15,)."""
    found = values + change
    found[:2] = values[:2] / (1 - change[:2])
    found[2:4] = values[2:4] + change[2:4] * found[:2]
    return found


def allowed(lens: Lens) -> np.ndarray:
    """A projection (15, 15) onto a lens's changes: equal focal lengths stay equal, and coefficients of 0 stay 0."""
    values = np.array(lens.values)
    onto = np.diag(np.where(np.arange(LENS_VALUES) < ENDS[1], 1.0, values != 0))
    if values[0] == values[1]:
        onto[:2, :2] = 0.5
    return onto if lens.chart != "equirectangular" else np.zeros_like(onto)


def ray_slopes(lens: Lens, rays: np.ndarray) -> np.ndarray:
    """Derivatives (2, 15, K) of the rays (K, 2) of fixed pixels by a change, at 0; 0 by what may not change."""

    def shown(change: np.ndarray, shift: np.ndarray) -> np.ndarray:
        moved = lens.with_values(corrected(np.array(lens.values), change).tolist())
        return pixels_of(moved, torch.from_numpy(rays + shift)).numpy()

    used, slopes = np.flatnonzero(np.diag(allowed(lens))), np.zeros((2, LENS_VALUES, len(rays)))
    still, fixed = np.zeros(LENS_VALUES), np.zeros(2)
    by_change = [shown(h, fixed) - shown(-h, fixed) for h in _STEP * np.eye(LENS_VALUES)[used]]
    by_ray = [shown(still, h) - shown(still, -h) for h in _STEP * np.eye(2)]
    slopes[:, used] = -np.linalg.solve(np.stack(by_ray, 2), np.stack(by_change, 2)).transpose(1, 2, 0)
    return slopes


def lens_gradient(numbers: np.ndarray, focal: np.ndarray, change: np.ndarray, native: bool) -> np.ndarray:
    """The gradient (15,) of a loss by a change, from that by a camera's numbers of an image.

    focal (2,): lengths after the change, pixels. native: whether the camera has a lens. The limits of the Jacobian's
    clamp count as fixed.
    """
    by_focal, by_center = numbers[_FOCAL:_AXIS], numbers[_AXIS : _AXIS + 2]
    if not native:
        by_focal = by_focal + numbers[_MEAN_FOCAL : _MEAN_FOCAL + 2]
    found = np.zeros(LENS_VALUES)
    found[:2] = (by_focal + change[2:4] * by_center) * focal / (1 - change[:2])
    found[2:4] = by_center * focal
    if native:
        found[4:] = numbers[_AXIS + 2 :]
    return found
