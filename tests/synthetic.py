"""Tiny scenes for the tests: a COLMAP model made by pycolmap and a Blender folder, with photos of coloured discs."""

import argparse
import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

WIDTH, HEIGHT = 96, 64
FOCAL = 110.0
CENTER = (45.0, 34.5)  # off the middle on purpose
VIEWS = 17
BROWN = (FOCAL, FOCAL, *CENTER, -0.2, 0.03, 0.004, -0.003)  # of a lens that distorts


def make_colmap_scene(
    folder: Path, *, model: str = "PINHOLE", params: tuple[float, ...] = (FOCAL, FOCAL, *CENTER), views: int = VIEWS
):
    """Write a scene of `views` photos into `folder` and return its pycolmap model, whose points are in a unit cube.

    The photos are in two sub-folders, with upper and lower case names, so that sorting by bytes shows.
    """
    import pycolmap

    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs = 1
    options.num_cameras_per_rig = 1
    options.num_frames_per_rig = views
    options.num_points3D = 300
    options.num_points2D_without_point3D = 0
    options.camera_width, options.camera_height = WIDTH, HEIGHT
    options.camera_model_id = getattr(pycolmap.CameraModelId, model)
    options.camera_params = list(params)
    pycolmap.set_random_seed(0)
    reconstruction = pycolmap.synthesize_dataset(options)
    rng = np.random.default_rng(0)
    for point in reconstruction.points3D.values():
        point.color = rng.integers(0, 256, 3).astype(np.uint8)
    for image_id, image in reconstruction.images.items():
        # Ids are in the reverse order of the names.
        number = views - image_id
        image.name = f"{'Right' if number % 2 else 'left'}/{'v' if number % 3 else 'V'}{number:02d}.png"
        path = folder / "images" / image.name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(_discs(reconstruction, image)).save(path)
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    reconstruction.write_binary(str(sparse))
    return reconstruction


def _discs(reconstruction, image) -> np.ndarray:
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    # A background that all photos had would be no part of the scene.
    blue = 120 + (13 if image.image_id % 2 else -13) + 0 * rows
    picture = np.stack([60 + columns, 100 + rows, blue], axis=-1).astype(np.uint8)
    from_world = image.cam_from_world()
    points = sorted(reconstruction.points3D.values(), key=lambda point: -(from_world * point.xyz)[2])
    for point in points:
        pixel = image.project_point(point.xyz)
        if pixel is not None:
            radius = 9.0 / (from_world * point.xyz)[2]
            (left, right), (top, bottom) = (
                (max(math.floor(at - radius), 0), max(math.ceil(at + radius), 0)) for at in pixel
            )
            near = np.s_[top:bottom, left:right]
            inside = (columns[near] + 0.5 - pixel[0]) ** 2 + (rows[near] + 0.5 - pixel[1]) ** 2 < radius**2
            picture[near][inside] = point.color
    return picture


def make_blender_scene(folder: Path, *, views: int = 4, size: tuple[int, int] = (40, 30)) -> None:
    """Write `views` training frames and half as many test frames, RGBA, with cameras on a circle of radius 4."""
    width, height = size
    rows, columns = np.mgrid[:height, :width]
    inside = (columns - width / 2) ** 2 + (rows - height / 2) ** 2 < (height / 3) ** 2
    for split, count in (("train", views), ("test", views // 2)):
        (folder / split).mkdir(parents=True, exist_ok=True)
        frames = []
        for index in range(count):
            angle = 2 * math.pi * index / count + (0.3 if split == "test" else 0)
            picture = np.zeros((height, width, 4), dtype=np.uint8)
            picture[inside] = (200, 40 * index, 90, 255)
            Image.fromarray(picture).save(folder / split / f"r_{index}.png")
            # OpenGL axes: the camera looks along -z of its frame, towards the origin.
            right, up = (math.cos(angle), math.sin(angle), 0), (0, 0, 1)
            back = (math.sin(angle), -math.cos(angle), 0)
            pose = np.eye(4)
            pose[:3] = np.column_stack([right, up, back, 4 * np.array(back)])
            frames.append({"file_path": f"./{split}/r_{index}", "transform_matrix": pose.tolist()})
        content = {"camera_angle_x": 0.7, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(content))


def make_nerfstudio_scene(folder: Path, *, distorted: bool = False, views: int = 17) -> None:
    """A COLMAP scene with a transforms.json written from pycolmap's poses."""
    from scene.readers.point_cloud import write_point_cloud

    model, params = ("OPENCV", BROWN) if distorted else ("PINHOLE", BROWN[:4])
    reconstruction = make_colmap_scene(folder, model=model, params=params, views=views)
    frames = []
    for image in reconstruction.images.values():
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().inverse().matrix()
        pose[:, 1:3] *= -1  # y up, z backward
        frames.append({"file_path": f"./images/{image.name}", "transform_matrix": pose.tolist(), "colmap_im_id": 1})
    content = {"w": 96, "h": 64, "fl_x": 110.0, "fl_y": 110.0, "cx": 45.0, "cy": 34.5, "frames": frames}
    if distorted:
        content |= dict(zip(("k1", "k2", "p1", "p2"), BROWN[4:], strict=True), camera_model="OPENCV")
    points = np.array([point.xyz for point in reconstruction.points3D.values()])
    write_point_cloud(folder / "sparse_pc.ply", points, np.full((len(points), 3), 90))
    (folder / "transforms.json").write_text(json.dumps(content | {"ply_file_path": "sparse_pc.ply"}))


class FakeGaussians:
    """A stand-in for the model in tests of data alone; keeps what the scene passes to it."""

    def create_from_pcd(self, pcd, cam_infos, spatial_lr_scale) -> None:
        self.pcd, self.cam_infos, self.extent = pcd, cam_infos, spatial_lr_scale

    def load_ply(self, path: str) -> None:
        self.loaded = path

    def save_ply(self, path: str) -> None:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).write_bytes(b"ply")


def folder_state(folder: Path) -> dict[str, tuple[int, bytes]]:
    """The time stamp and the bytes of every file below a folder."""
    return {
        str(path.relative_to(folder)): (path.stat().st_mtime_ns, path.read_bytes())
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def edit_json(path: Path, change: Callable[[dict], object]) -> None:
    """Change the content of a JSON file in place."""
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def as_text(scene: Path) -> None:
    """Convert the COLMAP model of a scene to text."""
    import pycolmap

    sparse = scene / "sparse" / "0"
    model = pycolmap.Reconstruction(str(sparse))
    for path in sparse.iterdir():
        path.unlink()
    model.write_text(str(sparse))


def options_of(scene: Path | str, out: Path, **changes: object) -> argparse.Namespace:
    """Model options of a scene and an output folder."""
    from arguments import ModelParams

    given = argparse.Namespace(source_path=str(scene), model_path=str(out), **changes)
    return ModelParams(argparse.ArgumentParser()).extract(given)


def read(scene: Path, hold_out: bool = False, init_pcd_path: str = "", **options: object):
    """Read a scene whose photos are in the folder images."""
    from scene.dataset_readers import read_scene

    return read_scene(scene, "images", hold_out, init_pcd_path, **options)
