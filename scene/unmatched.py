"""Detection of photos that a model puts in one place although they show different things that look alike.

In two rooms with the same poster, or with a box whose front and back are alike, all matches agree with the model, also
those between the parts. But matches are missing: a photo from nearly the same place should match the other nearly
everywhere, and matches it only on the poster.
"""

import contextlib
import sqlite3
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import pycolmap

_CELLS = 8  # of a photo, each way
_FEWEST = 5  # points of a cell that is asked
_ANGLE = 12.0  # degrees at a point between its two rays; features change with the direction,
_RATIO = 1.4  # and with the distance
_NEARER = 1.03  # times the distance of a cell's nearest point: what is farther may be hidden
_ASKED = 10  # cells of a pair that is asked
_SHARE = 0.25  # of these cells without a match; pairs of right models had 0.17 at most, of wrong ones up to 1


class Shown(NamedTuple):
    """The points of a model that a photo shows.

    numbers (N,): rows of the model's points. points (N, 3): world units. places (N, 2): pixels. count, nearest
    (_CELLS**2,): number of points in each cell, and distance of the nearest.
    """

    image: pycolmap.Image
    numbers: np.ndarray
    points: np.ndarray
    places: np.ndarray
    count: np.ndarray
    nearest: np.ndarray


class Overlap(NamedTuple):
    """Two photos whose points should be in each other. cells: number that should have matches. empty: without one."""

    first: str
    second: str
    cells: int
    empty: int

    @property
    def is_unmatched(self) -> bool:
        """True if the photos show different things."""
        return self.cells >= _ASKED and self.empty > _SHARE * self.cells


def collect_shown(image: pycolmap.Image, order: dict[int, int], points: np.ndarray) -> Shown:
    """Return what a photo of a model shows. points: world positions (P, 3). order: by id the row of a point."""
    seen = [(order[place.point3D_id], place.xy) for place in image.get_observation_points2D()]
    numbers = np.array([number for number, _ in seen], np.int64)
    places = np.array([xy for _, xy in seen], float).reshape(-1, 2)
    world = points[numbers]
    cells, nearest = _find_cells(image.camera, places), np.full(_CELLS**2, np.inf)
    np.minimum.at(nearest, cells, np.linalg.norm(world - image.projection_center(), axis=1))
    return Shown(image, numbers, world, places, np.bincount(cells, minlength=_CELLS**2), nearest)


def find_overlaps(model: pycolmap.Reconstruction, path: str) -> Iterator[Overlap]:
    """Yield an Overlap for each pair of posed photos whose features COLMAP has compared, also where none matched.

    path: of COLMAP's database, which lists the compared pairs and their matches.
    """
    database = pycolmap.Database.open(path)
    posed = {image.name: image for image in model.images.values() if image.has_pose}
    order = {number: row for row, number in enumerate(model.points3D)}
    points = np.array([point.xyz for point in model.points3D.values()], float).reshape(-1, 3)
    listed = [image for image in database.read_all_images() if image.name in posed]
    images = {image.image_id: collect_shown(posed[image.name], order, points) for image in listed}
    keypoints = {number: places_of(database.read_keypoints(number)) for number in images}
    verified = dict(zip(*database.read_two_view_geometries(), strict=True))
    database.close()
    with contextlib.closing(sqlite3.connect(path)) as connection:
        compared = sorted(number for (number,) in connection.execute("SELECT pair_id FROM two_view_geometries"))
    none = np.zeros((0, 2), int)
    for number in compared:
        pair = pycolmap.pair_id_to_image_pair(number)
        if all(one in images for one in pair):
            matches = verified[number].inlier_matches if number in verified else none
            places = [keypoints[one][matches[:, k]] for k, one in enumerate(pair)] if len(matches) else [none, none]
            first, second = (images[one] for one in pair)
            found = np.add(count_expected(first, second, places[1]), count_expected(second, first, places[0])).tolist()
            yield Overlap(first.image.name, second.image.name, *found)


def count_expected(one: Shown, other: Shown, matched: np.ndarray) -> tuple[int, int]:
    """Return the number of cells of the other photo that should have matches with the first, and of those without any.

    matched (M, 2): places of matches in the other photo, pixels.
    """
    camera, is_shared = (
        other.image.camera,
        np.zeros(1 + max(one.numbers.max(initial=0), other.numbers.max(initial=0)), bool),
    )
    is_shared[other.numbers] = True
    points = one.points[~is_shared[one.numbers]]
    rays = [points - photo.image.projection_center() for photo in (one, other)]
    away = [np.sqrt((ray**2).sum(1)) for ray in rays]
    is_like = (rays[0] * rays[1]).sum(1) > np.cos(np.radians(_ANGLE)) * away[0] * away[1]
    is_like &= (away[0] < _RATIO * away[1]) & (away[1] < _RATIO * away[0])
    if is_like.sum() < _FEWEST:
        return 0, 0
    is_shared[:] = False
    is_shared[one.numbers] = True
    got = np.bincount(
        _find_cells(camera, np.concatenate([matched, other.places[is_shared[other.numbers]]])), minlength=_CELLS**2
    )
    points, away = points[is_like], away[1][is_like]
    places = np.asarray(camera.img_from_cam(other.image.cam_from_world() * points), float).reshape(-1, 2)
    with np.errstate(invalid="ignore"):
        inside = ((places >= 0) & (places < [camera.width, camera.height])).all(1)
    cells = _find_cells(camera, places[inside])
    is_visible = (away[inside] < _NEARER * other.nearest[cells]) & (other.count[cells] >= _FEWEST)
    should = np.bincount(cells[is_visible], minlength=_CELLS**2) >= _FEWEST
    return int((should | (got > 0)).sum()), int((should & (got == 0)).sum())


def find_cover(pairs: Sequence[tuple[str, str]]) -> list[str]:
    """Return photos without which none of the pairs is left (a vertex cover): each time the one of most pairs."""
    left, found = list(pairs), []
    while left:
        counts = Counter(name for pair in left for name in pair)
        found.append(max(sorted(counts), key=counts.get))
        left = [pair for pair in left if found[-1] not in pair]
    return found


def _find_cells(camera: pycolmap.Camera, places: np.ndarray) -> np.ndarray:
    column, row = np.clip((places / [camera.width, camera.height] * _CELLS).astype(int), 0, _CELLS - 1).T
    return row * _CELLS + column


def places_of(keypoints: Any) -> np.ndarray:
    """Return the places (N, 2), pixels, of a database's keypoints."""
    return np.asarray(getattr(keypoints, "data", keypoints), float)[:, :2]
