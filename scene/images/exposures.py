"""Exposures of photos, by the points that they have in common, so that the content of a photo does not count."""

from collections.abc import Sequence

import numpy as np

EXPOSURES = 0.4  # stops; photos of a usual automatic exposure differ by 0.15 to 0.35
_DARK, _LIGHT = 0.02, 0.98  # of a channel; beyond, an exposure cannot be told
_OUTLIER = 0.6  # stops; a larger difference is no exposure (Tukey's biweight: Beaton and Tukey 1974)
_ROUNDS = 10
_LUMINANCE = (0.2126, 0.7152, 0.0722)  # of linear sRGB


def exposures(colors: Sequence[np.ndarray], points: Sequence[np.ndarray]) -> np.ndarray:
    """Exposures (N,) in stops around their mean, of N photos.

    colors, points: of each photo the colours (K,3), sRGB in [0, 1], of the points with these numbers (K,).
    """
    usable = [(values.max(1, initial=0) < _LIGHT) & (values.min(1, initial=1) > _DARK) for values in colors]
    logs = [np.log2(_to_linear(values[some]) @ _LUMINANCE) for values, some in zip(colors, usable, strict=True)]
    return _fit_levels(logs, [numbers[some] for numbers, some in zip(points, usable, strict=True)])


def _fit_levels(values: Sequence[np.ndarray], points: Sequence[np.ndarray]) -> np.ndarray:
    """Fit values (K,) of each photo's points robustly by photo plus point; return the photos' terms (N,), of mean 0."""
    value, photo = np.concatenate(values), np.repeat(np.arange(len(values)), [len(one) for one in values])
    point = np.unique(np.concatenate(points), return_inverse=True)[1]
    weight = np.ones(len(value))
    for _ in range(_ROUNDS):
        level, own = _fit_terms(value, weight, photo, point, len(values))
        away = value - level[photo] - own[point]
        weight = np.maximum(1 - (away / _OUTLIER) ** 2, 1e-3) ** 2
    return level - level.mean()


def _fit_terms(
    values: np.ndarray, weight: np.ndarray, photo: np.ndarray, point: np.ndarray, photos: int
) -> tuple[np.ndarray, np.ndarray]:
    """Fit values (K,) by a term for each photo (photos,) and each point, by weighted least squares.

    Points are eliminated (Triggs et al. 2000, section 6.1): fits of both in turns would take as many rounds as a walk
    has photos.
    """
    from scipy import sparse  # it takes a while to import
    from scipy.sparse.linalg import spsolve

    pairs = sparse.coo_array((weight, (photo, point)), (photos, point.max(initial=0) + 1)).tocsr()
    of_point, of_photo = (np.maximum(pairs.sum(axis), 1e-9) for axis in (0, 1))
    matrix = sparse.diags_array((1 + 1e-9) * of_photo) - pairs / of_point @ pairs.T  # singular else: their sum is free
    mean = np.bincount(point, weight * values) / of_point
    vector = np.bincount(photo, weight * (values - mean[point]), photos)
    level = spsolve(matrix.tocsc(), vector)
    return level, np.bincount(point, weight * (values - level[photo])) / of_point


def _to_linear(values: np.ndarray) -> np.ndarray:
    """Convert sRGB to linear light (IEC 61966-2-1)."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
