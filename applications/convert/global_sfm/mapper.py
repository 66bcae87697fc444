"""A model of all photos in one go: rotations, places, tracks, then bundle adjustments with tracks made anew between.

After each adjustment more matches agree with the poses than before, so points are made from all of them again instead
of repaired. Few points a photo are enough for poses and lenses; all are made once these stay.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pycolmap

from applications.convert.global_sfm.matches import Matches, read_matches
from applications.convert.global_sfm.model import make_model, make_views, read_views
from applications.convert.global_sfm.pairs import read_poses
from applications.convert.global_sfm.positions import place
from applications.convert.global_sfm.relative_poses import (
    RelativePoses,
)
from applications.convert.global_sfm.resection import keep_consistent, median_of_pairs, resect
from applications.convert.global_sfm.rotations import average_rotations, rotation_vectors
from applications.convert.global_sfm.tracks import (
    Tracks,
    Views,
    agreeing_matches,
    choose_longest,
    connect,
    epipolar_errors,
    triangulate,
)
from scene.epipolar import epipolar_angles

_AHEAD, _KNOWN = 0.9, np.radians(2.0)  # of a pair whose rotation counts: matches before both cameras, spread
_TURNED = np.radians(3.0)  # a pair whose rotation is off by more, and by more than three spreads, contradicts
_FITTING = 2.0  # pixels from a pair's own pose, of matches that make the first tracks
_FEWEST_SEEN, _LEAST = 15, 3  # points of a photo that is placed; photos of a model
_FEW = 100  # tracks of a photo that poses come from
# The same for the first places and the last poses: times photos, and the least and the most of a photo.
_START, _START_EACH = 8000, (50, 150)
_MANY, _MANY_EACH = 45000, (150, 600)
_CLEAR = 0.125  # of a limit: a pair whose median error is below does not contradict
# Pixels from the matches' rays and points, before and in the last adjustment, of which COLMAP has the limit.
_FIRST, _LAST = 12.0, 4.0


class _Round(NamedTuple):
    """An adjustment.

    limit: pixels, of matches and tracks. wanted: tracks of a photo, 0: all. width: pixels, of the loss. refines: the
    lenses, too. tolerance: share of the loss in a step, below which it ends.
    """

    limit: float
    wanted: int = 0
    width: float = 4.0
    refines: bool = True
    tolerance: float = 1e-3


class _Rotations(NamedTuple):
    """A set of photos with rotations. photos (K,): numbers. views: of all photos. fits (M,): matches that agree."""

    photos: np.ndarray
    views: Views
    fits: np.ndarray


def map_globally(path: str, calibrated: str, photos: str, threads: int) -> list[pycolmap.Reconstruction]:
    """Make a model of each set of photos that pairs connect, the largest first.

    path: of a database. calibrated: of a copy with calibrated focal lengths, of which `pose_pairs` was called. Its
    matches are not asked, as it lacks those that do not fit their pair's pose, which may be wrong. photos: folder, from
    which points take their colours. threads: of the adjustments; -1: all cores.
    """
    matches = replace(read_matches(path)[0], cameras=read_matches(calibrated)[0].cameras)
    mapper = _Mapper(matches, read_poses(calibrated), threads)
    left, models = np.ones(len(mapper.matches.images), bool), []
    while left.any() and (model := mapper.run(left)):
        model.extract_colors_for_all_images(photos)
        models.append(model)
    return models


class _Mapper:
    """Places sets of photos."""

    def __init__(self, matches: Matches, poses: RelativePoses, threads: int) -> None:
        self.matches, self._poses, self._threads = matches, poses, threads
        self._rays = matches.rays(matches.cameras)
        seen = self._rays[matches.features].swapaxes(0, 1)
        turned = (self._poses.rotations[matches.pair] @ seen[0][..., None])[..., 0]
        self._errors = np.abs(epipolar_angles(self._poses.directions[matches.pair], turned, seen[1])[0])
        self._own_errors = median_of_pairs(matches, self._errors)

    def run(self, left: np.ndarray) -> pycolmap.Reconstruction | None:
        """Return a model of the largest set of photos; None if no three are left that pairs connect.

        left (V,): photos to choose from; those of the set are taken out.
        """
        found = self._find_rotations(left)
        left[found.photos] = False
        return self._place(found) if len(found.photos) >= _LEAST else None

    def _find_rotations(self, left: np.ndarray) -> _Rotations:
        """Find rotations of the largest set of photos of those left (V,), and the matches to place it by."""
        matches, poses = self.matches, self._poses
        is_sure = (poses.ahead > _AHEAD) & (poses.spreads < _KNOWN) & left[matches.pairs].all(1)
        known = average_rotations(*(part[is_sure] for part in (matches.pairs, poses.rotations, poses.spreads)))
        views = make_views(len(matches.images), known)
        one, other = matches.pairs.T
        back = poses.rotations @ views.rotations[one] @ views.rotations[other].swapaxes(1, 2)
        off = np.linalg.norm(rotation_vectors(back), axis=1)
        agrees = (off < np.maximum(_TURNED, 3 * poses.spreads)) & views.posed[matches.pairs].all(1)
        limits = _FITTING / matches.pixels_a_radian(matches.cameras)[matches.pairs].mean(1)
        fits = agrees[matches.pair] & (self._errors < limits[matches.pair])
        return _Rotations(np.array(list(known), int), views, fits)

    def _place(self, found: _Rotations) -> pycolmap.Reconstruction | None:
        """Return the model of a set of photos with rotations; None if fewer than three of them see points enough."""
        matches, views = self.matches, found.views
        count = len(found.photos)
        tracks = choose_longest(matches, connect(matches, found.fits), int(np.clip(_START // count, *_START_EACH)))
        photo = matches.photo[tracks.features]
        seen, camera = np.unique(photo, return_inverse=True)
        if len(seen) < _LEAST:
            return None
        toward = views.turn(self._rays[tracks.features], photo)
        places, points = place(camera, tracks.track, toward)
        size = np.median(np.linalg.norm(places - np.median(places, 0), axis=1))
        views.posed[:] = False
        views.posed[seen], views.places[seen] = True, places / size
        model = make_model(matches, matches.cameras, views, tracks, points / size)
        self._adjust(model, _Round(0, refines=False))
        many = int(np.clip(_MANY // count, *_MANY_EACH))
        for one in (_Round(_FIRST, _FEW, 1.5), _Round(_LAST, many, 1, tolerance=1e-4)):
            model = self._triangulate(model, one)
            self._adjust(model, one)
        return _drop_unseen(self._triangulate(model, _Round(_LAST)))

    def _triangulate(self, model: pycolmap.Reconstruction, one: _Round) -> pycolmap.Reconstruction:
        """Return the poses of a model with tracks from all matches that agree with them.

        Photos that contradict the others, or have no pose, are placed by the tracks of the others, but at the end.
        """
        matches, cameras, views = self.matches, model.cameras, read_views(model, self.matches)
        rays, pixels = matches.rays(cameras), matches.pixels_a_radian(cameras)
        by_pair, by_feature = one.limit / pixels[matches.pairs].mean(1), one.limit / pixels[matches.photo]
        errors = epipolar_errors(matches, rays, views)
        if one.wanted:
            keep_consistent(matches, errors, self._own_errors, _CLEAR * by_pair, views)
            errors[~views.posed[matches.pairs].all(1)[matches.pair]] = np.inf
        points, tracks = self._make_points(errors, rays, views, by_pair, by_feature)
        if one.wanted and resect(matches, cameras, tracks, points, views, one.limit):
            errors = epipolar_errors(matches, rays, views)
            points, tracks = self._make_points(errors, rays, views, by_pair, by_feature)
        if one.wanted:
            chosen = choose_longest(matches, tracks, one.wanted)
            points = points[np.unique(tracks.track[np.isin(tracks.features, chosen.features)])]
            tracks = chosen
        return make_model(matches, cameras, views, tracks, points)

    def _make_points(
        self, errors: np.ndarray, rays: np.ndarray, views: Views, by_pair: np.ndarray, by_feature: np.ndarray
    ) -> tuple[np.ndarray, Tracks]:
        kept = agreeing_matches(self.matches, errors, by_pair)
        return triangulate(self.matches, connect(self.matches, kept), rays, views, by_feature)

    def _adjust(self, model: pycolmap.Reconstruction, one: _Round) -> None:
        """Adjust poses, points and lenses by COLMAP, under Cauchy's loss."""
        options = pycolmap.BundleAdjustmentOptions(print_summary=False)
        options.refine_focal_length, options.refine_extra_params = one.refines, one.refines
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = one.width
        options.ceres.solver_options.function_tolerance = one.tolerance
        options.ceres.solver_options.num_threads = self._threads
        pycolmap.bundle_adjustment(model, options)


def _drop_unseen(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction | None:
    """Take photos out that see few points; None if fewer than three are left."""
    for number in [one for one in model.reg_image_ids() if model.images[one].num_points3D < _FEWEST_SEEN]:
        model.deregister_frame(model.images[number].frame_id)
    model.update_point_3d_errors()
    return model if model.num_reg_images() >= _LEAST else None
