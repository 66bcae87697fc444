"""Judge a structure-from-motion model without ground truth, by the pairs of photos that it was made from.

A pair of photos has matches that passed a geometric check of the pair alone. Under the poses and lenses of a model, and
under the pair's own best geometry, they have an epipolar error. A pair contradicts the model where the first is much
larger. Photos are then grouped so that pairs within a group agree and pairs between groups contradict (correlation
clustering by greedy additive edge contraction, Keuper et al. 2015): a part of the scene in a wrong place agrees with
itself, and so do its photos with their neighbours, but not with the rest.
"""

import heapq
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import pycolmap

from scene.epipolar import epipolar_angles, fit_matrices, is_ahead, matrix_angles, medians, turn
from scene.rotation_only import rotation_error
from scene.unmatched import find_cover, find_overlaps, places_of

FEWEST = 15  # matches of a pair that is asked
WORSE = 2.5  # times a pair's own error, beyond which it contradicts,
FLOOR = 5e-4  # if that is also this share of the photo's longer side
_BEHIND = 0.7  # share of a pair's matches behind a photo, from which it contradicts; without parallax it is a half
_HEARD = 100  # matches of a pair that count; or two photos that show nearly the same would outvote all others
_SHARING = 10  # other photos of a photo, whose tracks are compared
_ROUNDS = 3  # of reweighted least squares
_AT_ONCE = 256  # pairs
# Other pairs' focal lengths are not known well enough, or they show nothing of depth (COLMAP's configurations).
_CALIBRATED = {
    int(kind)
    for kind in (
        pycolmap.TwoViewGeometryConfiguration.CALIBRATED,
        pycolmap.TwoViewGeometryConfiguration.PLANAR,
        pycolmap.TwoViewGeometryConfiguration.PLANAR_OR_PANORAMIC,
    )
}


class Pair(NamedTuple):
    """Two photos that match each other, and how well a model explains their matches.

    first, second: names of the photos.
    matches: number of matches that were judged.
    error: median epipolar error of the matches under the model's poses and lenses, pixels.
    own_error: the same under the geometry that fits this pair alone best.
    side: the longest side of the first photo, pixels.
    behind: share of the matches whose rays the model lets meet behind a camera, 0 to 1.
    """

    first: str
    second: str
    matches: int
    error: float
    own_error: float
    side: int
    behind: float = 0.0

    @property
    def contradicts(self) -> bool:
        """True if the model does not explain the pair's matches, though a geometry of the pair alone does."""
        return self.error > max(WORSE * self.own_error, FLOOR * self.side) or self.behind > _BEHIND


def judge(model: pycolmap.Reconstruction, database: str) -> dict[str, Any]:
    """Judge a model by the verified pairs of a database whose focal lengths are calibrated; the result is JSON.

    The result is `verdict` with further entries:
    bound: number of photos that pairs connect, those without a pose included;
    rotation: see rotation_error;
    alike: photos to leave out so that no two stand in one place and show different things;
    alike_pair: the clearest two of these, or None;
    left: the verdict without the photos of `against` and `alike`.
    """
    compared = sorted(find_overlaps(model, database), key=lambda pair: -pair.empty)
    alike = [pair[:2] for pair in compared if pair.is_unmatched]
    pairs = list(judge_pairs(model, database))
    found = verdict(pairs) | {
        "bound": len(largest_component(_list_linked_pairs(database))),
        "rotation": rotation_error(database),
        "alike": find_cover(alike),
        "alike_pair": alike[0] if alike else None,
    }
    out = {*found["against"], *found["alike"]}
    return found | {"left": verdict([pair for pair in pairs if out.isdisjoint(pair[:2])])}


def verdict(pairs: Sequence[Pair]) -> dict[str, Any]:
    """Summarise the pairs of a model.

    pairs: number of pairs;
    contradicting: share of matches that belong to contradicting pairs;
    error, own_error: medians over pairs, pixels;
    agreeing: number of photos in the largest group;
    against: photos that contradict this group; others may have no pair with it.
    """
    groups = consistent_groups((pair.first, pair.second, _weigh_pair(pair)) for pair in pairs)
    member = {name: number for number, group in enumerate(groups) for name in group}
    votes: dict[int, float] = {}
    for pair in pairs:
        one, other = sorted((member[pair.first], member[pair.second]))
        if one == 0 < other:
            votes[other] = votes.get(other, 0.0) + _weigh_pair(pair)
    matches = sum(pair.matches for pair in pairs)
    wrong = sum(pair.matches for pair in pairs if pair.contradicts)
    return {
        "pairs": len(pairs),
        "contradicting": round(wrong / matches, 4) if matches else 0.0,
        "error": round(float(np.median([pair.error for pair in pairs])), 4) if pairs else 0.0,
        "own_error": round(float(np.median([pair.own_error for pair in pairs])), 4) if pairs else 0.0,
        "agreeing": len(groups[0]) if groups else 0,
        "against": sorted(name for number, vote in votes.items() if vote < 0 for name in groups[number]),
    }


def judge_pairs(model: pycolmap.Reconstruction, path: str) -> Iterator[Pair]:
    """Judge the pairs of photos that COLMAP has matched by a model (`judge_rays`), and yield one Pair for each.

    Pairs are skipped if one photo has no pose in the model, if their focal lengths are not known well enough or they
    show no depth (_CALIBRATED), or if they have fewer than FEWEST matches.

    path: file of COLMAP's database, which has the pairs and their verified matches.
    """
    database = pycolmap.Database.open(path)
    posed = {image.name: image for image in model.images.values() if image.has_pose}
    images = {one.image_id: posed[one.name] for one in database.read_all_images() if one.name in posed}
    rays = {number: _compute_rays(image.camera, database.read_keypoints(number)) for number, image in images.items()}
    listed = []
    for number, geometry in zip(*database.read_two_view_geometries(), strict=True):
        first, second = pycolmap.pair_id_to_image_pair(number)
        if first in images and second in images and int(geometry.config) in _CALIBRATED:
            matches = geometry.inlier_matches
            listed.append((images[first], images[second], rays[first][matches[:, 0]], rays[second][matches[:, 1]]))
    database.close()
    yield from judge_rays(listed)


def judge_pairs_by_tracks(model: pycolmap.Reconstruction) -> Iterator[Pair]:
    """Judge pairs of photos that share points of a model, for a model without a database; yield one Pair for each.

    Each photo is paired with the _SHARING others that share most points with it, FEWEST at least. The points' places in
    the photos stand for matches. These pairs prove little if a program has removed matches that did not fit.
    """
    images = {number: model.images[number] for number in model.reg_image_ids()}
    seen: dict[int, dict[int, int]] = {number: {} for number in images}
    shared = {number: Counter() for number in images}
    for number, point in model.points3D.items():
        places = {element.image_id: element.point2D_idx for element in point.track.elements}
        for image, place in places.items():
            seen[image][number] = place
            shared[image].update(other for other in places if other != image)
    chosen = {(min(i, j), max(i, j)) for i in images for j, n in shared[i].most_common(_SHARING) if n >= FEWEST}
    rays = {
        i: _compute_rays(image.camera, np.array([p.xy for p in image.points2D]))
        for i, image in images.items()
        if seen[i]
    }
    listed = []
    for first, second in sorted(chosen):
        both = sorted(seen[first].keys() & seen[second].keys())
        matched = (rays[i][[seen[i][number] for number in both]] for i in (first, second))
        listed.append((images[first], images[second], *matched))
    yield from judge_rays(listed)


def judge_rays(
    listed: Sequence[tuple[pycolmap.Image, pycolmap.Image, np.ndarray, np.ndarray]],
) -> Iterator[Pair]:
    """Judge pairs by the poses of their photos; yield a Pair for each with FEWEST usable matches, in order.

    listed: two photos, and the unit rays (N, 3) of their matches in the first and in the other one, each in its
    camera's frame; a match whose ray is not finite is left out.
    """
    kept = []
    for one, other, *rays in listed:
        usable = np.isfinite(rays).all((0, 2))
        if usable.sum() >= FEWEST:
            kept.append((one, other, *(part[usable] for part in rays)))
    found: dict[int, Pair] = {}
    order = sorted(range(len(kept)), key=lambda number: len(kept[number][2]))  # pairs of one size are judged together
    for start in range(0, len(order), _AT_ONCE):
        some = order[start : start + _AT_ONCE]
        found.update(zip(some, _judge_some([kept[number] for number in some]), strict=True))
    yield from (found[number] for number in range(len(kept)))


def _judge_some(pairs: Sequence[tuple[pycolmap.Image, pycolmap.Image, np.ndarray, np.ndarray]]) -> list[Pair]:
    most = max(len(rays) for _, _, rays, _ in pairs)
    rays, used = np.zeros((2, len(pairs), most, 3)), np.zeros((len(pairs), most))
    turns, shifts, scales = np.zeros((len(pairs), 3, 3)), np.zeros((len(pairs), 3)), np.zeros(len(pairs))
    for number, (one, other, *seen) in enumerate(pairs):
        rays[:, number, : len(seen[0])] = seen
        used[number, : len(seen[0])] = 1
        moved = other.cam_from_world() * one.cam_from_world().inverse()
        turns[number], shifts[number] = moved.rotation.matrix(), moved.translation
        scales[number] = (_count_pixels_a_radian(one.camera) + _count_pixels_a_radian(other.camera)) / 2
    shifts /= np.maximum(np.linalg.norm(shifts, axis=1, keepdims=True), 1e-12)
    turned = turn(turns, rays[0])
    errors = epipolar_angles(shifts[:, None], turned, rays[1])[0]
    own = matrix_angles(fit_matrices(*rays, used, _ROUNDS), *rays)[0]
    # An essential matrix has no sign that tells where rays meet.
    behind = 1 - (is_ahead(shifts[:, None], turned, rays[1]) * used).sum(1) / used.sum(1)
    numbers = zip(medians(np.abs(errors), used) * scales, medians(np.abs(own), used) * scales, behind, strict=True)
    return [
        Pair(
            one.name,
            other.name,
            len(seen),
            float(error),
            float(best),
            max(one.camera.width, one.camera.height),
            float(share),
        )
        for (one, other, seen, _), (error, best, share) in zip(pairs, numbers, strict=True)
    ]


def consistent_groups(pairs: Iterable[tuple[Any, Any, float]]) -> list[list[Any]]:
    """Group photos so that pairs within a group agree with the model, and pairs between groups contradict.

    pairs: two photos each and their vote, for one group if positive, against it if negative. The two groups with the
    most votes between them are joined, while these are positive. Returns lists of photos, the largest group first.
    """
    votes: dict[Any, dict[Any, float]] = {}
    for first, second, vote in pairs:
        votes.setdefault(first, {})[second] = votes.setdefault(second, {})[first] = vote
    groups = {name: [name] for name in votes}
    heap = [(-vote, one, other) for one, row in votes.items() for other, vote in row.items() if vote > 0]
    heapq.heapify(heap)
    while heap:
        vote, one, other = heapq.heappop(heap)
        if one not in votes or votes[one].get(other) != -vote:
            continue  # joined since, or with other votes
        if len(votes[one]) < len(votes[other]):
            one, other = other, one
        groups[one] += groups.pop(other)
        for third, more in votes.pop(other).items():
            del votes[third][other]
            if third != one:
                votes[one][third] = votes[third][one] = total = votes[one].get(third, 0.0) + more
                if total > 0:
                    heapq.heappush(heap, (-total, one, third))
    return sorted(groups.values(), key=lambda group: (-len(group), min(group)))


def largest_component(links: Iterable[tuple[Any, Any]]) -> set[Any]:
    """The largest set of things that links connect."""
    near: dict[Any, set[Any]] = {}
    for one, other in links:
        near.setdefault(one, set()).add(other)
        near.setdefault(other, set()).add(one)
    largest: set[Any] = set()
    while near:
        found, new = set(), {next(iter(near))}
        while new:
            found |= new
            new = set().union(*(near.pop(one) for one in new)) - found
        largest = max(largest, found, key=len)
    return largest


def _list_linked_pairs(path: str) -> list[tuple[int, int]]:
    """List the pairs (id, id) of photos with at least 2 * FEWEST verified matches in a COLMAP database."""
    database = pycolmap.Database.open(path)
    counted = zip(*database.read_two_view_geometry_num_inliers(), strict=True)
    links = [pycolmap.pair_id_to_image_pair(number) for number, count in counted if count >= 2 * FEWEST]
    database.close()
    return links


def _weigh_pair(pair: Pair) -> float:
    """Return the vote of a pair: its number of matches, _HEARD at most, negative if it contradicts the model."""
    return min(pair.matches, _HEARD) * (-1.0 if pair.contradicts else 1.0)


def _compute_rays(camera: pycolmap.Camera, keypoints: Any) -> np.ndarray:
    rays = np.asarray(camera.cam_ray_from_img(places_of(keypoints)), float).reshape(-1, 3)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _count_pixels_a_radian(camera: pycolmap.Camera) -> float:
    """Pixels of a radian in the middle of a photo."""
    return camera.mean_focal_length() if camera.focal_length_idxs() else camera.width / (2 * np.pi)
