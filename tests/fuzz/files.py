"""Cases of datasets: COLMAP models, transforms.json, point clouds."""

import json
import random
import shutil
from pathlib import Path

import numpy as np
from synthetic import as_text, make_blender_scene, make_colmap_scene

import train
from fuzz.damage import changed, damaged, damaged_text
from scene.dataset_readers import read_scene
from scene.readers.colmap import read_model_of_kind
from scene.readers.depth_scale import sightings
from scene.readers.info import SceneInfo
from scene.readers.point_cloud import read_point_cloud, write_point_cloud
from utils.graphics_utils import getProjectionMatrix

_TRAINED = 0.04  # share of the readable scenes that are trained, too


class Colmap:
    """One file of a COLMAP model is damaged, binary or text; what can still be read must be usable."""

    def __init__(self, folder: Path) -> None:
        self._scenes = {}
        for suffix in ("bin", "txt"):
            scene = self._scenes[suffix] = folder / f"colmap_{suffix}"
            make_colmap_scene(scene, views=9)
        as_text(self._scenes["txt"])

    def run(self, rng: random.Random) -> None:
        suffix = rng.choice(("bin", "bin", "txt"))
        scene = self._scenes[suffix]
        files = sorted((scene / "sparse" / "0").glob(f"*.{suffix}"))
        path = rng.choice(files)
        whole = path.read_bytes()
        # Half of the damages hit the first records, which have more of the counts.
        head = min(len(whole), rng.choice((200, len(whole))))
        if suffix == "bin":
            path.write_bytes(damaged(rng, whole[:head]) + whole[head:])
        else:
            path.write_text(damaged_text(rng, whole.decode()))
        try:
            _read_and_train(rng, scene)
            model = read_model_of_kind(path.parent, suffix, with_2d_points=True)
            for image in model.images:
                pixels, depths = sightings(image, model.points, model.cameras[image.camera_id], "the model")
                assert len(pixels) == len(depths), "a photo's points and their depths differ in number"
        finally:
            path.write_bytes(whole)


class Transforms:
    """The camera file of a Blender or nerfstudio scene is damaged."""

    def __init__(self, folder: Path) -> None:
        blender, nerfstudio = folder / "blender", folder / "nerfstudio"
        make_blender_scene(blender, views=2)
        write_point_cloud(blender / "points3d.ply", np.eye(3), np.zeros((3, 3), np.uint8))
        shutil.copytree(blender, nerfstudio)
        content = json.loads((nerfstudio / "transforms_train.json").read_text())
        content |= {"ply_file_path": "points3d.ply", "camera_model": "OPENCV", "test_filenames": ["./train/r_0.png"]}
        content |= {"w": 40, "h": 30, "fl_x": 50.0, "k1": 0.0, "cx": 20.0, "cy": 15.0}
        for path in nerfstudio.glob("transforms_*.json"):
            path.unlink()
        (nerfstudio / "transforms.json").write_text(json.dumps(content))
        self._files = [blender / "transforms_train.json", nerfstudio / "transforms.json"]

    def run(self, rng: random.Random) -> None:
        path = rng.choice(self._files)
        whole = path.read_bytes()
        if rng.random() < 0.3:
            path.write_bytes(damaged(rng, whole))
        else:
            path.write_text(json.dumps(changed(rng, json.loads(whole))))
        try:
            _read_and_train(rng, path.parent)
        finally:
            path.write_bytes(whole)


class Cloud:
    """A point cloud is damaged: PLY, npz or text."""

    def __init__(self, folder: Path) -> None:
        draws = np.random.default_rng(0)
        points, colors = draws.normal(size=(20, 3)), draws.integers(0, 256, (20, 3)).astype(np.uint8)
        write_point_cloud(folder / "cloud.ply", points, colors)
        np.savez(folder / "cloud.npz", points=points, colors=colors)
        header = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property float {name}\n" for name in "xyz")
        header += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue")) + "end_header\n"
        self._whole = [(folder / name).read_bytes() for name in ("cloud.ply", "cloud.npz")]
        self._whole += [(header + "0 1 2 3 4 5\n0 1 2 3 4 5\n").encode(), b"x y z r g b\n1 2 3 4 5 6\n1 2 3 4 5 6\n"]
        self._path = folder / "damaged_cloud"

    def run(self, rng: random.Random) -> None:
        whole = rng.choice(self._whole)
        if whole[:3] != b"PK\x03" and rng.random() < 0.5:
            # latin-1 keeps every byte
            self._path.write_bytes(damaged_text(rng, whole.decode("latin-1")).encode("latin-1"))
        else:
            self._path.write_bytes(damaged(rng, whole))
        cloud = read_point_cloud(self._path)
        assert np.isfinite(cloud.points.astype(np.float32)).all(), "points that are not finite were accepted"
        assert len(cloud.points) == len(cloud.colors) == len(cloud.normals), "arrays differ in length"
        assert ((cloud.colors >= 0) & (cloud.colors <= 1)).all(), "colours beyond 0 to 1"


def _read_and_train(rng: random.Random, scene: Path) -> None:
    info = read_scene(scene, "images", rng.random() < 0.5)
    _check(info)
    if rng.random() < _TRAINED:
        out = scene.parent / "trained"
        shutil.rmtree(out, ignore_errors=True)
        train.main(["-s", str(scene), "-m", str(out), "--iterations", "2", "--quiet", "-r", "4"])


def _check(info: SceneInfo) -> None:
    assert 0 < info.extent < np.inf, f"extent {info.extent}"
    for camera in info.train_cameras + info.test_cameras:
        projection = getProjectionMatrix(0.01, 100.0, camera.FovX, camera.FovY)
        values = [*camera.center, *camera.T, camera.fx, camera.fy, camera.cx, camera.cy, *np.ravel(projection)]
        assert np.isfinite(np.array(values, dtype=np.float32)).all(), f"camera {camera.image_name} is not finite"
        assert min(camera.fx, camera.fy, camera.width, camera.height) > 0
        is_rotation = np.allclose(camera.R @ camera.R.T, np.eye(3), rtol=0, atol=0.01) and np.linalg.det(camera.R) > 0
        assert is_rotation, f"camera {camera.image_name} has no rotation"
