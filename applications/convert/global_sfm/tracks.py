"""Tracks: the features of several photos that matches say are one point, and the points that they see."""

from typing import NamedTuple

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from applications.convert.global_sfm.matches import Matches
from scene.epipolar import epipolar_angles, is_ahead

_FEWEST = 8  # matches of a pair that agree with the poses, and
_SHARE = 0.3  # share of them, else none of the pair is used
_FITS = 6  # of reweighted least squares
_NARROW = np.radians(0.75)  # from the mean of a point's rays to the outermost; below it the depth is not known


class Tracks(NamedTuple):
    """Features by track: track (N,) numbers from 0 without a gap, features (N,) of Matches; no two of one photo."""

    track: np.ndarray
    features: np.ndarray

    @property
    def count(self) -> int:
        """Number of tracks."""
        return int(self.track.max(initial=-1)) + 1

    def where(self, kept: np.ndarray) -> "Tracks":
        """Return the features that are kept (N,), with tracks numbered anew."""
        return Tracks(np.unique(self.track[kept], return_inverse=True)[1], self.features[kept])


class Views(NamedTuple):
    """Poses of photos, by their numbers in Matches: posed (V,); rotations (V, 3, 3) world to camera; places (V, 3)."""

    posed: np.ndarray
    rotations: np.ndarray
    places: np.ndarray

    def turn(self, rays: np.ndarray, photo: np.ndarray) -> np.ndarray:
        """Turn rays (N, 3) in the cameras' frames of photos (N,) into the world's frame."""
        return (rays[:, None, :] @ self.rotations[photo])[:, 0]


def connect(matches: Matches, kept: np.ndarray) -> Tracks:
    """Connect features along the matches that are kept (M,), without tracks that have two features of one photo."""
    linked = matches.features[kept]
    features, ends = np.unique(linked, return_inverse=True)
    links = scipy.sparse.coo_matrix((np.ones(len(linked), np.int8), ends.reshape(-1, 2).T), (len(features),) * 2)
    track = connected_components(links, directed=False)[1]
    photo = matches.photo[features]
    order = np.lexsort((photo, track))
    track, photo, features = track[order], photo[order], features[order]
    twice = np.zeros(int(track.max(initial=-1)) + 1, bool)
    twice[track[1:][(track[1:] == track[:-1]) & (photo[1:] == photo[:-1])]] = True
    return Tracks(track, features).where(~twice[track])


def choose_longest(matches: Matches, tracks: Tracks, wanted: int) -> Tracks:
    """Keep the longest tracks, of three features or more, until each photo has the number that is wanted."""
    length = np.bincount(tracks.track)
    cut = np.append(0, np.cumsum(length))
    photo, have, kept = matches.photo[tracks.features], np.zeros(len(matches.images), int), np.zeros(len(length), bool)
    for number in np.argsort(-length, kind="stable"):
        if length[number] < 3:
            break
        seen = photo[cut[number] : cut[number + 1]]
        if have[seen].min() < wanted:
            kept[number] = True
            have[seen] += 1
    return tracks.where(kept[tracks.track])


def epipolar_errors(matches: Matches, rays: np.ndarray, views: Views) -> np.ndarray:
    """Return the angles (M,), radians, by which matches miss the poses of their photos.

    Infinite without poses, or where rays meet behind a camera. rays (F, 3): of features, in their cameras' frames.
    """
    first, second = views.turn(rays, matches.photo)[matches.features].swapaxes(0, 1)
    one, other = matches.pairs.T
    shift = views.places[one] - views.places[other]
    shift = (shift / np.maximum(np.linalg.norm(shift, axis=1, keepdims=True), 1e-12))[matches.pair]
    is_seen = is_ahead(shift, first, second) & views.posed[matches.pairs].all(1)[matches.pair]
    return np.where(is_seen, np.abs(epipolar_angles(shift, first, second)[0]), np.inf)


def agreeing_matches(matches: Matches, errors: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Find the matches (M,) with errors below the limits (P,) of their pairs, and not alone in their pair."""
    agrees = errors < limits[matches.pair]
    counts = [np.bincount(matches.pair, some, len(matches.pairs)) for some in (agrees, np.ones(len(agrees)))]
    return agrees & ((counts[0] >= _FEWEST) & (counts[0] > _SHARE * counts[1]))[matches.pair]


def triangulate(
    matches: Matches, tracks: Tracks, rays: np.ndarray, views: Views, limits: np.ndarray
) -> tuple[np.ndarray, Tracks]:
    """Return points (P, 3) and their tracks without features beyond the limits, and without narrow or single rays.

    Reweighted least squares on the angles between rays and points, under Cauchy's loss.

    rays (F, 3): of features, in their cameras' frames. limits (F,): radians.
    """
    track, photo = tracks.track, matches.photo[tracks.features]
    limit, start = limits[tracks.features], views.places[photo]
    toward = views.turn(rays[tracks.features], photo)
    # Normal equations of the distances to the rays, by columns: the identity's weight, toward x toward, right side.
    products = toward[:, [0, 0, 0, 1, 1, 2]] * toward[:, [0, 1, 2, 1, 2, 2]]
    across = start - toward * (start * toward).sum(1, keepdims=True)
    columns = np.concatenate([np.ones((len(track), 1)), products, across], 1)
    weight, points, away, error = np.ones(len(track)), np.zeros((tracks.count, 3)), start, limit
    for _ in range(_FITS):
        sums = sum_by(track, columns * weight[:, None], tracks.count)
        normal = sums[:, :1, None] * (1 + 1e-9) * np.eye(3) - sums[:, [1, 2, 3, 2, 4, 5, 3, 5, 6]].reshape(-1, 3, 3)
        points = np.linalg.solve(normal, sums[:, 7:, None])[..., 0]
        away = points[track] - start
        distance = np.maximum(np.sqrt((away**2).sum(1)), 1e-9)
        along = (away * toward).sum(1) / distance
        off = away / distance[:, None] - along[:, None] * toward
        error = np.where(along > 0, np.sqrt((off**2).sum(1)), 2.0)
        weight = 1 / (1 + (error / limit) ** 2) / distance**2
    fits = error < limit
    direction = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    mean = sum_by(track, direction * fits[:, None], tracks.count)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    widest = np.zeros(tracks.count)
    np.maximum.at(widest, track[fits], np.arccos(np.clip((direction * mean[track]).sum(1), -1, 1))[fits])
    several = np.bincount(track, fits, tracks.count) >= 2
    kept = fits & (several & (widest > _NARROW))[track]
    return points[np.unique(track[kept])], tracks.where(kept)


def sum_by(group: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Sum values (N, ...) by their groups (N,), in order; the result is (count, ...)."""
    flat = values.reshape(len(values), -1)
    sums = np.stack([np.bincount(group, column, count) for column in flat.T], -1)
    return sums.reshape(count, *values.shape[1:])
