"""Groups of Gaussians as one Gaussian each, by moments.

A Gaussian's weight is its footprint: opacity times mean area of its shadow, which for a convex body is a quarter of its
surface (Cauchy 1841). The merged mean, covariance and SH coefficients are the weighted moments of the group, where the
covariance has the spread of the means in it (Runnalls 2007, "Kullback-Leibler approach to Gaussian mixture reduction");
the merged opacity keeps the footprint, up to opaque. Weights by opacity and surface, and an opacity that is the sum of
weights over the surface, are those of Kerbl et al. 2024, "A hierarchical 3D Gaussian representation for real-time
rendering of very large datasets".
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from scene.splats.splats import Splats, opacities

_POWER = 1.6075  # of Thomsen's formula for the surface of an ellipsoid, which is within 1.1 %
_MOST = 0.999  # opacity of a merged Gaussian
_THIN = 1e-7  # least ratio of a merged Gaussian's scales, above the rounding of its covariance


def shadow_areas(scales: np.ndarray) -> np.ndarray:
    """Mean areas (N,) of the shadows of ellipsoids with half axes (N, 3), over all directions; float64."""
    a, b, c = scales.astype(np.float64).T
    powers = (a * b) ** _POWER + (a * c) ** _POWER + (b * c) ** _POWER
    return np.pi * (powers / 3) ** (1 / _POWER)


def footprints(splats: Splats) -> np.ndarray:
    """Opacities times mean areas (N,) float64, in squared units of the means."""
    return opacities(splats) * shadow_areas(np.exp(splats.log_scales.astype(np.float64)))


def covariances(splats: Splats) -> np.ndarray:
    """Covariances (N, 3, 3) float64."""
    axes = (
        Rotation.from_quat(splats.rotations, scalar_first=True).as_matrix()
        * np.exp(splats.log_scales.astype(np.float64))[:, None]
    )
    return axes @ axes.transpose(0, 2, 1)


def merge_groups(splats: Splats, starts: np.ndarray) -> tuple[Splats, np.ndarray]:
    """One Gaussian for each group, and the spread (G,) of its means: their weighted RMS distance from the merged mean.

    starts: (G,) indices, ascending from 0; a group ends where the next one starts. A group of footprint 0 counts each
    of its Gaussians the same, and stays transparent.
    """
    sizes = np.diff(np.append(starts, len(splats)))
    weights = footprints(splats)
    totals = np.add.reduceat(weights, starts)
    shares = np.where(np.repeat(totals, sizes) > 0, weights, 1.0)
    shares /= np.repeat(np.add.reduceat(shares, starts), sizes)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(values * shares.reshape(-1, *(1,) * (values.ndim - 1)), starts, axis=0)

    places = splats.means.astype(np.float64)
    middle = mean(places)
    apart = places - np.repeat(middle, sizes, axis=0)
    between = mean(apart[:, :, None] * apart[:, None])
    scales, rotations = _find_axes(mean(covariances(splats)) + between)
    opacity = np.minimum(totals / shadow_areas(scales), _MOST)
    with np.errstate(divide="ignore"):  # the logit of 0 is infinite
        logits = np.log(opacity) - np.log1p(-opacity)
    values = {
        "means": middle,
        "log_scales": np.log(scales),
        "rotations": rotations,
        "opacity_logits": logits,
        "sh": mean(splats.sh.astype(np.float64)),
    }
    spread = np.sqrt(np.trace(between, axis1=1, axis2=2))
    return replace(splats, **{name: value.astype(np.float32) for name, value in values.items()}), spread


def _find_axes(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Scales (N, 3) and quaternions (N, 4), wxyz, of covariances (N, 3, 3)."""
    squares, axes = np.linalg.eigh(covariance)
    axes[np.linalg.det(axes) < 0, :, 0] *= -1  # a rotation, not a reflection
    scales = np.sqrt(np.maximum(squares, 0))
    scales = np.maximum(scales, _THIN * scales.max(axis=1, keepdims=True))
    return np.maximum(scales, np.exp(-80.0)), Rotation.from_matrix(axes).as_quat(scalar_first=True)
