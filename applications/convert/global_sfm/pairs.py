"""Poses of the pairs of a COLMAP database, once focal lengths are calibrated."""

from pathlib import Path

import numpy as np
import pycolmap

from applications.convert.database import opened
from applications.convert.global_sfm.matches import read_matches
from applications.convert.global_sfm.relative_poses import (
    RelativePoses,
    relative_poses,
)
from scene.epipolar import epipolar_angles, is_ahead

_FITTING = 1.0  # pixels; COLMAP's limits for calibrated pairs, in matches, too:
_FEWEST, _SHARE = 30, 0.25
_AHEAD, _KNOWN = 0.7, np.radians(2.0)  # share of the fitting matches before both cameras; spread of the rotation
_KINDS = pycolmap.TwoViewGeometryConfiguration


def pose_pairs(path: str) -> None:
    """Write the poses of calibrated pairs into a database, and leave their matches out that do not fit.

    Pairs with too few that fit before both cameras, or without a certain rotation, are called degenerate.
    """
    matches, geometries = read_matches(path)
    seen = matches.rays(matches.cameras)[matches.features].swapaxes(0, 1)
    poses = relative_poses(matches.pair, *seen)
    turned, shift = (poses.rotations[matches.pair] @ seen[0][..., None])[..., 0], poses.directions[matches.pair]
    error, _ = epipolar_angles(shift, turned, seen[1])
    fits = np.abs(error) * matches.pixels_a_radian(matches.cameras)[matches.pairs].mean(1)[matches.pair] < _FITTING
    ahead = fits & is_ahead(shift, turned, seen[1])
    counts = [np.bincount(matches.pair, some, len(geometries)) for some in (ahead, fits, np.ones(len(fits)))]
    is_sound = (counts[0] >= np.maximum(_FEWEST, _SHARE * counts[2])) & (counts[0] > _AHEAD * counts[1])
    is_sound &= poses.spreads < _KNOWN
    kept_of = np.split(fits, np.searchsorted(matches.pair, np.arange(1, len(geometries))))[: len(geometries)]
    database = opened(path)
    with pycolmap.DatabaseTransaction(database):
        for number, (geometry, kept) in enumerate(zip(geometries, kept_of, strict=True)):
            if geometry.config != _KINDS.CALIBRATED:
                continue
            if not is_sound[number]:
                geometry.config = _KINDS.DEGENERATE
            else:
                pose = pycolmap.Rotation3d(poses.rotations[number]), poses.directions[number]
                geometry.cam2_from_cam1 = pycolmap.Rigid3d(*pose)
                geometry.inlier_matches = geometry.inlier_matches[kept]
            one, other = (matches.images[photo].image_id for photo in matches.pairs[number])
            database.update_two_view_geometry(one, other, geometry)
    database.close()
    np.savez(_find_record(path), *poses)


def read_poses(path: str) -> RelativePoses:
    """Read the poses of all pairs that `pose_pairs` found for a database, also of those it calls degenerate."""
    with np.load(_find_record(path)) as record:
        return RelativePoses(*record.values())


def _find_record(path: str) -> Path:
    return Path(path).with_suffix(".npz")
