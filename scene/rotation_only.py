"""Detection of a camera that turns without moving, so that photos show no depth.

Structure from motion with an unknown focal length makes cameras on a circle of them, which agree with all matches. What
tells: rotations alone explain the matches of every pair, with one factor of the focal lengths for all.
"""

import numpy as np
import pycolmap

from scene.unmatched import places_of

FEWEST = 15  # matches of a pair that is asked
_PART = 90  # per cent of the pairs
_PAIRS, _MATCHES = 150, 100  # that are asked
_USUAL = 0.6  # focal length by the longer side, where neither EXIF data nor pairs tell it
# Of the focal lengths. Through longer lenses, a flat wall that passes by looks like one before a camera that turns.
_FACTORS = np.geomspace(0.5, 2.0, 29)
_ROUNDS = 4  # of reweighted least squares
_CLIPPED = 0.03  # of the longer side: worse pairs do not decide on the focal length


def rotation_error(path: str) -> float | None:
    """Return the error that rotations alone leave in the pairs of a database, as a share of the photos' longer side.

    Median over a pair's matches, then 90th percentile over pairs, for the factor of the focal lengths that fits best.
    None: no pair has enough matches through perspective lenses.
    """
    places, focals, sides = _read_matches(path)
    if not len(places):
        return None
    errors = np.stack([_fit_rotations(places, factor * focals) for factor in _FACTORS]) / sides
    best = np.minimum(errors, _CLIPPED).mean(1).argmin()
    return float(np.percentile(errors[best], _PART))


def _fit_rotations(places: np.ndarray, focals: np.ndarray) -> np.ndarray:
    """Return the median distance (P,), pixels, of matches from where the best rotation of each pair takes them.

    places (P, 2, M, 2): pixels from the photos' middles. focals (P, 2).
    """
    rays = np.concatenate([places / focals[..., None, None], np.ones((*places.shape[:3], 1))], -1)
    one, other = np.moveaxis(rays / np.linalg.norm(rays, axis=-1, keepdims=True), 1, 0)
    weights = error = np.ones(one.shape[:2])
    for _ in range(_ROUNDS):
        # Kabsch's rotation of unit vectors.
        left, _, right = np.linalg.svd(np.einsum("pm,pmi,pmj->pij", weights, other, one))
        left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
        turned = one @ np.swapaxes(left @ right, 1, 2)
        ahead = np.maximum(turned[..., 2:], 0.05)
        error = np.linalg.norm(turned[..., :2] / ahead * focals[:, 1, None, None] - places[:, 1], axis=-1)
        usual = np.maximum(1.5 * np.median(error, axis=1, keepdims=True), 1e-9)
        weights = 1 / (1 + (error / usual) ** 2)
    return np.median(error, axis=1)


def _read_matches(path: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Read places of matches (P, 2, M, 2), pixels from the photos' middles, focal lengths (P, 2), longer sides (P,)."""
    database = pycolmap.Database.open(path)
    cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
    images = {image.image_id: cameras[image.camera_id] for image in database.read_all_images()}
    verified = []
    for number, geometry in zip(*database.read_two_view_geometries(), strict=True):
        pair = pycolmap.pair_id_to_image_pair(number)
        if len(geometry.inlier_matches) >= FEWEST and all(_is_perspective(images[one]) for one in pair):
            verified.append((pair, geometry.inlier_matches))
    places, focals, sides = [], [], []
    for pair, matches in verified[:: -(-len(verified) // _PAIRS) or 1]:
        some = matches[np.linspace(0, len(matches) - 1, _MATCHES).astype(int)].T
        seen = [
            (images[one], places_of(database.read_keypoints(one))[rows]) for one, rows in zip(pair, some, strict=True)
        ]
        places.append([pixels - [camera.width / 2, camera.height / 2] for camera, pixels in seen])
        focals.append([_estimate_focal_length(camera) for camera, _ in seen])
        sides.append(max(seen[0][0].width, seen[0][0].height))
    database.close()
    return np.array(places), np.array(focals), np.array(sides)


def _is_perspective(camera: pycolmap.Camera) -> bool:
    return len(camera.focal_length_idxs()) > 0 and not camera.is_perspective_fisheye()


def _estimate_focal_length(camera: pycolmap.Camera) -> float:
    is_known = camera.has_prior_focal_length
    return camera.mean_focal_length() if is_known else _USUAL * max(camera.width, camera.height)
