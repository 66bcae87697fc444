"""COLMAP's models from poses and tracks as arrays, and back."""

from collections.abc import Mapping

import numpy as np
import pycolmap

from applications.convert.global_sfm.matches import Matches
from applications.convert.global_sfm.tracks import Tracks, Views


def make_views(count: int, rotations: Mapping[int, np.ndarray]) -> Views:
    """Make views of some of `count` photos by their rotations, in the origin."""
    views = Views(np.zeros(count, bool), np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)))
    for photo, rotation in rotations.items():
        views.posed[photo], views.rotations[photo] = True, rotation
    return views


def read_views(model: pycolmap.Reconstruction, matches: Matches) -> Views:
    """Read the poses of a model."""
    rows = {image.image_id: number for number, image in enumerate(matches.images)}
    poses = {rows[one]: model.images[one].cam_from_world() for one in model.reg_image_ids()}
    views = make_views(len(rows), {number: pose.rotation.matrix() for number, pose in poses.items()})
    for number, pose in poses.items():
        views.places[number] = -views.rotations[number].T @ pose.translation
    return views


def make_model(
    matches: Matches, cameras: Mapping[int, pycolmap.Camera], views: Views, tracks: Tracks, points: np.ndarray
) -> pycolmap.Reconstruction:
    """Make a model of lenses, poses, and points (P, 3) with their tracks."""
    model = pycolmap.Reconstruction()
    for camera in cameras.values():
        model.add_camera_with_trivial_rig(camera)
    cut = np.append(matches.first_feature, len(matches.places))
    for number in np.flatnonzero(views.posed):
        known, turn = matches.images[number], views.rotations[number]
        image = pycolmap.Image(
            name=known.name,
            camera_id=known.camera_id,
            image_id=known.image_id,
            keypoints=matches.places[cut[number] : cut[number + 1]],
        )
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), -turn @ views.places[number])
        model.add_image_with_trivial_frame(image, pose)
    photo = matches.photo[tracks.features]
    images = np.array([image.image_id for image in matches.images])[photo].tolist()
    features = (tracks.features - matches.first_feature[photo]).tolist()
    ends = np.cumsum(np.bincount(tracks.track)).tolist()
    for point, start, end in zip(points, [0, *ends], ends, strict=False):
        elements = map(pycolmap.TrackElement, images[start:end], features[start:end])
        model.add_point3D(point, pycolmap.Track(list(elements)))
    return model
