"""Global structure from motion, on COLMAP's own synthetic scenes, whose poses and points are known."""

import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from applications.convert import worker
from applications.convert.global_sfm import mapper
from applications.convert.global_sfm.matches import Matches, read_matches
from applications.convert.global_sfm.pairs import pose_pairs, read_poses
from applications.convert.global_sfm.positions import place
from applications.convert.global_sfm.relative_poses import relative_poses
from applications.convert.global_sfm.rotations import average_rotations, rotation_vectors
from applications.convert.global_sfm.tracks import connect

PIXELS = 0.3  # noise of features
FRAMES = 12


def _scene(folder: Path, noise: float = PIXELS, **changed: object) -> tuple[pycolmap.Reconstruction, str]:
    """A model of two cameras' photos around points, and the path of a database with its matches, verified."""
    path = str(folder / "database.db")
    options = pycolmap.SyntheticDatasetOptions()
    given = {"num_rigs": 2, "num_frames_per_rig": FRAMES // 2, "num_points3D": 300, "track_length": 6, **changed}
    for name, value in given.items():
        setattr(options, name, value)
    pycolmap.set_random_seed(3)
    database = pycolmap.Database.open(path)
    model = pycolmap.synthesize_dataset(options, database)
    noisy = pycolmap.SyntheticNoiseOptions()
    noisy.point2D_stddev = noise
    pycolmap.synthesize_noise(noisy, model, database)
    kinds = pycolmap.TwoViewGeometryConfiguration
    for number, geometry in zip(*database.read_two_view_geometries(), strict=True):
        geometry.config = kinds.CALIBRATED
        database.update_two_view_geometry(*pycolmap.pair_id_to_image_pair(number), geometry)
    database.close()
    return model, path


def _true_relative(model: pycolmap.Reconstruction, matches: Matches) -> tuple[np.ndarray, np.ndarray]:
    poses = [model.images[image.image_id].cam_from_world() for image in matches.images]
    moved = [poses[other] * poses[one].inverse() for one, other in matches.pairs]
    shifts = np.array([pose.translation / np.linalg.norm(pose.translation) for pose in moved])
    return np.array([pose.rotation.matrix() for pose in moved]), shifts


def _errors(model: pycolmap.Reconstruction, found: pycolmap.Reconstruction) -> np.ndarray:
    """Distances of placed photos from their true places after COLMAP's robust similarity, as shares of the radius."""
    true = {image.name: image.projection_center() for image in model.images.values()}
    names = [found.images[number].name for number in found.reg_image_ids()]
    places = np.array([found.find_image_with_name(name).projection_center() for name in names])
    wanted = np.array([true[name] for name in names])
    fit = pycolmap.estimate_sim3d_robust(places, wanted, pycolmap.RANSACOptions(max_error=0.05))["tgt_from_src"]
    return np.linalg.norm(fit * places - wanted, axis=1) / np.linalg.norm(wanted - wanted.mean(0), axis=1).mean()


def test_pairs_are_posed_and_their_spread_is_that_of_the_errors(tmp_path):
    model, path = _scene(tmp_path)
    matches, _ = read_matches(path)
    turns, shifts = _true_relative(model, matches)
    seen = matches.rays(model.cameras)[matches.features].swapaxes(0, 1)
    rng = np.random.default_rng(0)
    wrong = rng.random(len(matches.pair)) < 0.1
    seen[1][wrong] = rng.permutation(seen[1][wrong])
    poses = relative_poses(matches.pair, *seen)
    known = poses.spreads < np.radians(1.0)
    off = np.linalg.norm(rotation_vectors(poses.rotations @ turns.swapaxes(1, 2)), axis=1)
    assert known.mean() > 0.9 and np.median(off[known]) < np.radians(0.15)
    assert np.median((poses.directions * shifts).sum(1)[known]) > np.cos(np.radians(0.5))
    assert 0.5 < np.median(off[known] / poses.spreads[known]) < 2
    assert np.median(poses.ahead) > 0.85


def test_rotations_are_averaged_without_wrong_pairs():
    rng = np.random.default_rng(1)
    true = Rotation.random(20, random_state=1).as_matrix()
    pairs = np.array([(i, j) for i in range(20) for j in range(i + 1, 20) if j - i < 7])
    noise = Rotation.from_rotvec(rng.normal(0, 0.003, (len(pairs), 3))).as_matrix()
    turns = noise @ true[pairs[:, 1]] @ true[pairs[:, 0]].swapaxes(1, 2)
    wrong = rng.random(len(pairs)) < 0.25
    turns[wrong] = Rotation.random(int(wrong.sum()), random_state=2).as_matrix()
    found = average_rotations(pairs, turns, np.full(len(pairs), 0.005))
    assert sorted(found) == [*range(20)]
    world = np.array([true[number].T @ found[number] for number in range(20)])  # the same for all
    assert np.linalg.norm(rotation_vectors(world @ world[0].T), axis=1).max() < 0.02


def test_places_need_no_start_and_bear_wrong_rays():
    rng = np.random.default_rng(2)
    cameras = np.stack([4 * np.cos(np.arange(15) / 3), 4 * np.sin(np.arange(15) / 3), rng.normal(0, 0.5, 15)], 1)
    points = rng.uniform(-1, 1, (80, 3))
    camera, track = np.nonzero(rng.random((15, 80)) < 0.5)
    toward = points[track] - cameras[camera]
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    toward += rng.normal(0, 0.001, toward.shape)
    wrong = rng.random(len(toward)) < 0.05
    toward[wrong] = rng.normal(size=(int(wrong.sum()), 3))
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    found, _ = place(camera, track, toward)
    wanted = cameras - cameras[0]
    scale = (found * wanted).sum() / (found**2).sum()
    assert np.linalg.norm(scale * found - wanted, axis=1).max() < 0.02


def test_a_track_with_two_features_of_a_photo_is_left_out(tmp_path):
    _, path = _scene(tmp_path)
    matches, _ = read_matches(path)
    kept = np.ones(len(matches.pair), bool)
    whole = connect(matches, kept)
    assert len(np.unique(whole.features)) == len(whole.features)
    # A match from the first track to another feature of the same photo.
    one = whole.features[whole.track == 0]
    other = next(f for f in whole.features[whole.track == 1] if matches.photo[f] in matches.photo[one])
    matches.features[0] = [one[0], other]
    assert connect(matches, kept).count == whole.count - 2


LENSES = {
    "SIMPLE_RADIAL": [1280.0, 512.0, 384.0, 0.05],
    "OPENCV": [900.0, 900.0, 512.0, 384.0, -0.05, 0.02, 0.0, 0.0],
    "OPENCV_FISHEYE": [500.0, 500.0, 512.0, 384.0, 0.02, -0.01, 0.0, 0.0],
    "EQUIRECTANGULAR": [1024.0, 512.0],
}


@pytest.mark.parametrize("lens", LENSES)
def test_a_scene_is_placed(tmp_path, lens):
    size = {"camera_width": 1024, "camera_height": 512 if lens == "EQUIRECTANGULAR" else 768}
    given = {"camera_model_id": getattr(pycolmap.CameraModelId, lens), "camera_params": LENSES[lens], **size}
    model, path = _scene(tmp_path, camera_has_prior_focal_length=True, **given)
    found = _map(path, tmp_path, model)
    assert found.num_reg_images() == FRAMES and _errors(model, found).max() < 0.02
    assert found.compute_mean_reprojection_error() < 3 * PIXELS


def _map(path: str, folder: Path, model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    for image in model.images.values():
        (folder / "photos" / image.name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (image.camera.width, image.camera.height)).save(folder / "photos" / image.name, "PNG")
    calibrated = shutil.copy(path, folder / "calibrated.db")
    pose_pairs(str(calibrated))
    (found,) = mapper.map_globally(path, str(calibrated), str(folder / "photos"), 1)
    return found


def test_the_same_bytes_in_every_run(tmp_path):
    model, path = _scene(tmp_path)
    for name in ("a", "b"):
        found = _map(path, tmp_path, model)
        (tmp_path / name).mkdir()
        found.write(str(tmp_path / name))
    for file in ("cameras.bin", "images.bin", "points3D.bin"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_mapping_grows_from_the_photos_that_agree_and_leaves_the_whole_model_as_it_is(tmp_path):
    model, path = _scene(tmp_path)
    found = _map(path, tmp_path, model)
    base = tmp_path / "tried" / "direct" / "0"
    base.mkdir(parents=True)
    found.write(str(base))
    before = (base / "images.bin").read_bytes()
    places = {"models": str(tmp_path / "tried" / "grown"), "base": str(base), "images": str(tmp_path / "photos")}
    places |= {"database": path, "calibrated": str(tmp_path / "calibrated.db"), "small": str(tmp_path / "none")}
    out = sorted(image.name for image in found.images.values())[:2]
    worker.mapping({"mapper": "grown", "left_out": out, "tolerance": 1e-6, **places})
    grown = pycolmap.Reconstruction(str(tmp_path / "tried" / "grown" / "0"))
    assert grown.num_reg_images() == FRAMES and _errors(model, grown).max() < 0.02
    assert (base / "images.bin").read_bytes() == before
    assert sorted(path.name for path in (tmp_path / "tried").iterdir()) == ["direct", "grown"]


def test_pairs_of_chance_are_called_degenerate(tmp_path):
    _, path = _scene(tmp_path)
    database = pycolmap.Database.open(path)
    numbers, geometries = database.read_two_view_geometries()
    pair, geometry = pycolmap.pair_id_to_image_pair(numbers[0]), geometries[0]
    matches = geometry.inlier_matches.copy()
    matches[:, 1] = np.random.default_rng(0).permutation(matches[:, 1])
    geometry.inlier_matches = matches
    database.update_two_view_geometry(*pair, geometry)
    database.close()
    pose_pairs(path)
    database = pycolmap.Database.open(path)
    kinds = pycolmap.TwoViewGeometryConfiguration
    assert database.read_two_view_geometry(*pair).config == kinds.DEGENERATE
    other = database.read_two_view_geometry(*pycolmap.pair_id_to_image_pair(numbers[1]))
    database.close()
    assert other.config == kinds.CALIBRATED and other.cam2_from_cam1 is not None
    assert len(read_poses(path).spreads) == len(numbers)


def test_a_database_without_pairs_makes_no_model(tmp_path):
    path = str(tmp_path / "database.db")
    pycolmap.Database.open(path).close()
    pose_pairs(path)
    assert mapper.map_globally(path, path, str(tmp_path), 1) == []
