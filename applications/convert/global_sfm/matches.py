"""The verified matches of a COLMAP database as flat arrays, with features numbered through all photos."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pycolmap

from applications.convert.database import opened
from scene.unmatched import places_of

FEWEST = 15  # matches of a pair that is used


@dataclass
class Matches:
    """Photos, their features, and the matches of pairs of photos.

    images: the database's images, in the order of their ids, by which `photo` and `pairs` number them.
    cameras: the database's cameras by id.
    places (F, 2): pixels of all features. photo (F,): the photo of each.
    first_feature (V,): number of each photo's first feature.
    pairs (P, 2): photos. pair (M,): the pair of each match, in order. features (M, 2): its features in both photos.
    """

    images: list[pycolmap.Image]
    cameras: dict[int, pycolmap.Camera]
    places: np.ndarray
    photo: np.ndarray
    first_feature: np.ndarray
    pairs: np.ndarray
    pair: np.ndarray
    features: np.ndarray

    def rays(self, cameras: Mapping[int, pycolmap.Camera]) -> np.ndarray:
        """Return unit rays (F, 3) of the features in their cameras' frames; zeros where a lens has none.

        cameras: lenses by the ids of the database's.
        """
        rays = np.zeros((len(self.places), 3))
        cut = np.append(self.first_feature, len(self.places))
        for image, start, end in zip(self.images, cut[:-1], cut[1:], strict=True):
            rays[start:end] = np.reshape(cameras[image.camera_id].cam_ray_from_img(self.places[start:end]), (-1, 3))
        length = np.linalg.norm(rays, axis=1, keepdims=True)
        return np.where(np.isfinite(length) & (length > 0), rays / np.maximum(length, 1e-12), 0.0)

    def pixels_a_radian(self, cameras: Mapping[int, pycolmap.Camera]) -> np.ndarray:
        """Return the pixels (V,) of a radian in the middle of each photo."""
        lenses = [cameras[image.camera_id] for image in self.images]
        return np.array(
            [lens.mean_focal_length() if lens.focal_length_idxs() else lens.width / (2 * np.pi) for lens in lenses]
        )


def read_matches(path: str) -> tuple[Matches, list[pycolmap.TwoViewGeometry]]:
    """Read the pairs of a database with FEWEST verified matches or more, and COLMAP's geometry of each pair."""
    database = opened(path)
    images = sorted(database.read_all_images(), key=lambda image: image.image_id)
    places = [places_of(database.read_keypoints(image.image_id)).reshape(-1, 2) for image in images]
    cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
    found = sorted(zip(*database.read_two_view_geometries(), strict=True), key=lambda one: one[0])
    database.close()
    row = {image.image_id: number for number, image in enumerate(images)}
    counts = np.array([len(one) for one in places], int)
    first = np.cumsum(counts) - counts
    kept = [(number, geometry) for number, geometry in found if len(geometry.inlier_matches) >= FEWEST]
    pairs = np.array([[row[one] for one in pycolmap.pair_id_to_image_pair(number)] for number, _ in kept], int)
    pairs = pairs.reshape(-1, 2)
    listed = [
        geometry.inlier_matches.astype(int) + first[pair] for (_, geometry), pair in zip(kept, pairs, strict=True)
    ]
    return (
        Matches(
            images,
            cameras,
            np.concatenate([np.zeros((0, 2)), *places]),
            np.repeat(np.arange(len(images)), counts),
            first,
            pairs,
            np.repeat(np.arange(len(kept)), [len(one) for one in listed]),
            np.concatenate([np.zeros((0, 2), int), *listed]),
        ),
        [geometry for _, geometry in kept],
    )
