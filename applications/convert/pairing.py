"""Choice of the pairs of photos that are matched.

Of few photos all are. Of many, those that are near each other by name, by GPS and by look, which closes loops. Then
photos that are not yet bound to the largest group are matched with more of it, until they are bound or were tried.
"""

import contextlib
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from applications.convert.database import opened
from scene.agreement import largest_component

_NEXT, _NEAREST, _NEAREST_BY_GPS = 5, 20, 10  # other photos of a photo
_MORE = 40  # of the group, which a photo outside of it is matched with first; then twice as many, and so on
_MOST = 50  # such pairs, times the number of photos: their number grows with that of the photos, not with its square
_BOUND = 30  # matches that passed the geometric check, of a pair that binds
_WORDS, _SAMPLED, _ROUNDS = 64, 200, 10  # of VLAD; features of a photo that find the words
_SEED = 0

Pairs = set[tuple[int, int]]


def plan_rounds(path: str, all_of: int) -> Iterator[Pairs]:
    """Yield sets of pairs of image ids, the smaller one first. The database must have each set's matches before more.

    path: of a database with features. all_of: number of photos, up to which every pair is matched.
    """
    database = opened(path)
    images = sorted(database.read_all_images(), key=lambda image: image.name)
    numbers = [image.image_id for image in images]
    if len(numbers) <= all_of:
        database.close()
        yield {order_pair(one, other) for k, one in enumerate(numbers) for other in numbers[k + 1 :]}
        return
    alike = compute_likeness(database, numbers)
    places = read_gps_places(database, numbers)
    database.close()
    tried = {order_pair(numbers[i], numbers[j]) for i, j in choose_first_pairs(alike, places)}
    yield tried
    left, more = _MOST * len(numbers), _MORE
    while True:
        group = largest_component(find_bound_pairs(path))
        inside = np.array([number in group for number in numbers])
        new: Pairs = set()
        for place in np.flatnonzero(~inside):
            order = [other for other in np.argsort(-alike[place], kind="stable") if inside[other]]
            new |= {order_pair(numbers[place], numbers[other]) for other in order[:more]}
        new = set(sorted(new - tried)[:left])
        if not new:
            return
        yield new
        tried |= new
        left, more = left - len(new), 2 * more


def choose_first_pairs(alike: np.ndarray, places: np.ndarray) -> Iterator[tuple[int, int]]:
    """Pairs of photos, in order of names, that are near by name, look (N, N) and place (N, 3; NaN: not known)."""
    count = len(alike)
    for one in range(count):
        yield from ((one, other) for other in range(one + 1, min(one + 1 + _NEXT, count)))
        away = np.linalg.norm(places - places[one], axis=1)
        away[one] = np.nan
        near = [other for other in np.argsort(away, kind="stable")[:_NEAREST_BY_GPS] if np.isfinite(away[other])]
        yield from ((one, int(other)) for other in (*np.argsort(-alike[one], kind="stable")[:_NEAREST], *near))


def order_pair(one: int, other: int) -> tuple[int, int]:
    return min(one, other), max(one, other)


def compute_likeness(database: pycolmap.Database, numbers: list[int]) -> np.ndarray:
    """Return the similarity (N, N) of photos, -1 on the diagonal: products of VLAD descriptors (Jegou et al. 2010).

    The words of the descriptors are found among the photos' own SIFT features, so that nothing learned is needed.
    """
    rng = np.random.default_rng(_SEED)
    sample = np.concatenate([_sample_rows(_read_features(database, number), rng) for number in numbers])
    if not len(sample):
        return np.zeros((len(numbers), len(numbers)), np.float32)
    words = sample[rng.permutation(len(sample))[:_WORDS]]
    for _ in range(_ROUNDS):
        words = _normalize_rows(_sum_groups(sample, (sample @ words.T).argmax(1), len(words)))
    found = np.zeros((len(numbers), words.size), np.float32)
    for place, number in enumerate(numbers):
        features = _read_features(database, number)
        nearest = (features @ words.T).argmax(1)
        found[place] = _normalize_rows(_sum_groups(features - words[nearest], nearest, len(words))).ravel()
    found = _normalize_rows(found)
    alike = found @ found.T
    np.fill_diagonal(alike, -1)
    return alike


def read_gps_places(database: pycolmap.Database, numbers: list[int]) -> np.ndarray:
    """Places (N, 3) by EXIF, in metres from the middle of the Earth; NaN where they are not known."""
    earth = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    places = np.full((len(numbers), 3), np.nan)
    order = {number: place for place, number in enumerate(numbers)}
    for prior in database.read_all_pose_priors():
        place = order.get(prior.corr_data_id.id)
        if place is not None and prior.coordinate_system == pycolmap.PosePriorCoordinateSystem.WGS84:
            known = np.nan_to_num(np.asarray(prior.position, float).reshape(1, 3), nan=0.0)  # a height may be missing
            places[place] = earth.ellipsoid_to_ecef(known)[0]
    return places


def find_bound_pairs(path: str) -> list[tuple[int, int]]:
    """Pairs with enough verified matches to bind their photos."""
    database = opened(path)
    counted = zip(*database.read_two_view_geometry_num_inliers(), strict=True)
    pairs = [pycolmap.pair_id_to_image_pair(number) for number, count in counted if count >= _BOUND]
    database.close()
    return pairs


def match_pairs(path: str, pairs: Pairs, listed: Path, **how: Any) -> None:
    """Match and verify pairs of a database. listed: a file for them. how: options of pycolmap.match_image_pairs."""
    listed.write_text("".join(f"{one} {other}\n" for one, other in sorted(pairs)), encoding="utf-8")
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(listed)
    with name_by_id(path):
        pycolmap.match_image_pairs(path, pairing_options=pairing, **how)


@contextlib.contextmanager
def name_by_id(path: str) -> Iterator[None]:
    """Name the images of a database by their ids: a list of pairs is divided at blanks, which names may contain."""
    restore_names(path)
    with contextlib.closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("CREATE TABLE photo_names AS SELECT image_id, name FROM images")
        connection.execute("UPDATE images SET name = image_id")
    yield
    restore_names(path)


def restore_names(path: str) -> None:
    """Undo `name_by_id`, also where it was interrupted."""
    with contextlib.closing(sqlite3.connect(path)) as connection, connection:
        if connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'photo_names'").fetchone():
            own = "SELECT name FROM photo_names WHERE photo_names.image_id = images.image_id"
            connection.execute(f"UPDATE images SET name = ({own})")
            connection.execute("DROP TABLE photo_names")


def _read_features(database: pycolmap.Database, number: int) -> np.ndarray:
    """Unit descriptors (K, 128) of a photo."""
    return _normalize_rows(np.asarray(database.read_descriptors(number).data, np.float32).reshape(-1, 128))


def _sample_rows(features: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return features[rng.permutation(len(features))[:_SAMPLED]]


def _normalize_rows(rows: np.ndarray) -> np.ndarray:
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-9)


def _sum_groups(rows: np.ndarray, groups: np.ndarray, count: int) -> np.ndarray:
    sums = np.zeros((count, rows.shape[1]), np.float32)
    np.add.at(sums, groups, rows)
    return sums
