"""Folders as other programs export them, made from a model of pycolmap and its photos.

Each function writes the files that the program documents, and returns the points of the model in the world of the
export (N,3), in the order of their ids. Photos keep their stems.
"""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image

from scene.readers.point_cloud import write_point_cloud

STAMP = 1_700_000_000_000_000  # microseconds, as Polycam names its files
TURN = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # from one world to another
SCALE, SHIFT = 2.5, np.array([40.0, -7.0, 12.0])


def points_of(model: pycolmap.Reconstruction) -> np.ndarray:
    """The points (N,3) in the order of their ids."""
    return np.array([point.xyz for _, point in sorted(model.points3D.items())])


def stem_of(image: pycolmap.Image) -> str:
    """A name without folder and suffix, in lower case: of one photo only."""
    return Path(image.name).stem.lower()


def _photos(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    return sorted(model.images.values(), key=stem_of)


def _arkit(image: pycolmap.Image) -> np.ndarray:
    """Camera to world (4,4): x right, y up, z backward."""
    pose = np.eye(4)
    pose[:3] = image.cam_from_world().inverse().matrix()
    return pose @ np.diag([1, -1, -1, 1])


def _copy(photo: Path, target: Path) -> None:
    """A photo in the format of another suffix."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if photo.suffix == target.suffix:
        shutil.copy(photo, target)
    else:
        Image.open(photo).save(target, quality=95, subsampling=0)


def _as_text(model: pycolmap.Reconstruction, folder: Path, name: Callable[[pycolmap.Image], str]) -> None:
    folder.mkdir(parents=True)
    for image in model.images.values():
        image.name = name(image)
    model.write_text(str(folder))
    for extra in ("rigs.txt", "frames.txt"):  # of COLMAP 4 alone
        (folder / extra).unlink(missing_ok=True)


def realityscan(model: pycolmap.Reconstruction, images: Path, folder: Path) -> np.ndarray:
    """Export > Registration > COLMAP: text, a PINHOLE camera for each photo, undistorted photos, no 2D points."""
    points = points_of(model)
    for image in _photos(model):
        _copy(images / image.name, folder / "images" / f"{stem_of(image)}.png")
    _as_text(model, folder / "sparse" / "0", lambda image: f"{stem_of(image)}.png")
    sparse = folder / "sparse" / "0"
    camera = next(line for line in (sparse / "cameras.txt").read_text().splitlines() if line[0] != "#")
    lines = [line for line in (sparse / "images.txt").read_text().splitlines() if line[:1] != "#"][::2]
    cameras = [" ".join([str(number), *camera.split()[1:]]) for number in range(1, len(lines) + 1)]
    fields = [line.split() for line in lines]
    rows = [" ".join([*row[:8], str(number), row[9]]) for number, row in enumerate(fields, start=1)]
    (sparse / "cameras.txt").write_text("\n".join(cameras) + "\n")
    (sparse / "images.txt").write_text("\n\n".join(rows) + "\n\n")
    kept = [line.split()[:8] for line in (sparse / "points3D.txt").read_text().splitlines() if line[0] != "#"]
    (sparse / "points3D.txt").write_text("".join(" ".join(row) + "\n" for row in kept))
    return points


def opf2colmap(model: pycolmap.Reconstruction, images: Path, folder: Path) -> np.ndarray:
    """opf2colmap of Pix4D's pyopf, into sparse/0: text, FULL_OPENCV, photos in their sub-folders, comments first."""
    points = points_of(model)
    shutil.copytree(images, folder / "images")
    _as_text(model, folder / "sparse" / "0", lambda image: image.name)
    for path in (folder / "sparse" / "0").iterdir():
        path.write_text(f"# {path.stem} list with one line of data\n#   of OPF\n" + path.read_text())
    return points


def nerfstudio(model: pycolmap.Reconstruction, images: Path, folder: Path) -> np.ndarray:
    """ns-process-data images: transforms.json in a turned world, sparse_pc.ply, the COLMAP model below colmap."""
    camera = next(iter(model.cameras.values()))
    names = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")
    content = {"w": camera.width, "h": camera.height, **dict(zip(names, camera.params.tolist(), strict=True))}
    turn, frames = np.eye(4), []
    turn[:3, :3] = TURN
    for number, image in enumerate(_photos(model), start=1):
        for part in ("images", "images_2"):
            _copy(images / image.name, folder / part / f"{stem_of(image)}.png")
        pose = (turn @ _arkit(image)).tolist()
        frames.append({"file_path": f"images/{stem_of(image)}.png", "transform_matrix": pose, "colmap_im_id": number})
    content |= {"camera_model": "OPENCV", "frames": frames, "applied_transform": turn[:3].tolist()}
    points = points_of(model) @ TURN.T
    write_point_cloud(folder / "sparse_pc.ply", points, np.full(points.shape, 90))
    (folder / "transforms.json").write_text(json.dumps(content | {"ply_file_path": "sparse_pc.ply"}))
    shutil.copytree(images.parent / "sparse", folder / "colmap" / "sparse")
    return points


def nerfcapture(model: pycolmap.Reconstruction, images: Path, folder: Path) -> np.ndarray:
    """NeRFCapture, offline: transforms.json with lenses for each frame, photos named without suffix, depth beside."""
    frames = []
    for image in _photos(model):
        camera = model.cameras[image.camera_id]
        path = f"images/{stem_of(image)}"
        _copy(images / image.name, folder / f"{path}.png")
        Image.new("L", (camera.width, camera.height)).save(folder / f"{path}.depth.png")
        lens = dict(zip(("fl_x", "fl_y", "cx", "cy"), camera.params.tolist(), strict=True))
        frame = {"file_path": path, "depth_path": f"{path}.depth.png", "transform_matrix": _arkit(image).tolist()}
        frames.append({**frame, "timestamp": 1.5, "w": camera.width, "h": camera.height, **lens})
    shared = {**frames[0], "depth_integer_scale": 1.0}
    for name in ("file_path", "depth_path", "transform_matrix", "timestamp"):
        del shared[name]
    (folder / "transforms.json").write_text(json.dumps({**shared, "frames": frames}))
    return points_of(model)


def polycam(model: pycolmap.Reconstruction, images: Path, folder: Path, corrected: bool = True) -> np.ndarray:
    """Polycam's raw data: a JSON a photo with the rows of its pose, depth in millimetres, raw.glb in another frame."""
    keyframes = folder / "keyframes"
    for name in ("depth", "cameras", "corrected_cameras")[: 3 if corrected else 2]:
        (keyframes / name).mkdir(parents=True)
    for image in _photos(model):
        camera, name = model.cameras[image.camera_id], str(STAMP + 1000 * int(stem_of(image)[1:]))
        lens = dict(zip(("fx", "fy", "cx", "cy"), camera.params.tolist(), strict=True))
        content = {**lens, "width": camera.width, "height": camera.height, "blur_score": 120.5, "timestamp": int(name)}
        pose = _arkit(image)
        rows = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
        if corrected:
            _copy(images / image.name, keyframes / "corrected_images" / f"{name}.jpg")
            (keyframes / "corrected_cameras" / f"{name}.json").write_text(json.dumps(content | rows))
            rows["t_03"] += 0.3  # drift
        _copy(images / image.name, keyframes / "images" / f"{name}.jpg")
        (keyframes / "cameras" / f"{name}.json").write_text(json.dumps(content | rows))
        depth = np.full((camera.height // 2, camera.width // 2), 1250, np.uint16)
        Image.fromarray(depth).save(keyframes / "depth" / f"{name}.png")
    (folder / "mesh_info.json").write_text(json.dumps({"alignmentTransform": np.eye(4).ravel().tolist()}))
    (folder / "raw.glb").write_bytes(b"glTF")
    return points_of(model)


def record3d(model: pycolmap.Reconstruction, images: Path, folder: Path, r3d: bool = False) -> np.ndarray:
    """Record3D's export EXR + JPG, or an unpacked .r3d: quaternions x y z w with places, the lens by columns."""
    name, photos = ("metadata", "rgbd") if r3d else ("metadata.json", "rgb")
    camera = next(iter(model.cameras.values()))
    fx, fy, cx, cy = camera.params.tolist()
    poses = []
    for number, image in enumerate(_photos(model)):
        _copy(images / image.name, folder / photos / f"{number}.jpg")
        pose = _arkit(image)
        quaternion = pycolmap.Rotation3d(pose[:3, :3]).quat  # x y z w
        poses.append([*quaternion.tolist(), *pose[:3, 3].tolist()])
    content = {"w": camera.width, "h": camera.height, "dw": 192, "dh": 256, "fps": 60, "initPose": poses[0]}
    content |= {"K": [fx, 0, 0, 0, fy, 0, cx, cy, 1], "poses": poses, "cameraType": 1}
    if r3d:
        content |= {"perFrameIntrinsicCoeffs": [[fx, fy, cx, cy]] * len(poses), "K": [1, 0, 0, 0, 1, 0, 0, 0, 1]}
    (folder / name).write_text(json.dumps(content))
    return points_of(model)


def metashape(model: pycolmap.Reconstruction, images: Path, folder: Path, rig: bool = False) -> np.ndarray:
    """Export Cameras as Agisoft XML: poses in the chunk's frame, a component with the way to the world, unaligned
    photos, photos in sub-folders by their bare names, the point cloud of the world as points3D.ply.

    rig: each photo has a sensor, whose place is told beside the first one's, and the third photo alone has a pose.
    """
    camera, photos = next(iter(model.cameras.values())), _photos(model)
    fx, fy, cx, cy, *terms = camera.params.tolist()
    kind = "fisheye" if camera.model.name == "OPENCV_FISHEYE" else "frame"
    names = ("k1", "k2", "k3", "k4") if kind == "fisheye" else ("k1", "k2", "p2", "p1")  # OpenCV's p1, p2, exchanged
    values = {"f": fy, "cx": cx - camera.width / 2, "cy": cy - camera.height / 2, "b1": fx - fy}
    values |= dict(zip(names, terms, strict=True))
    resolution = _xml("resolution", width=camera.width, height=camera.height)
    lenses = resolution
    for state, numbers in (("adjusted", values), ("initial", {"f": 50.0})):
        terms = [_xml(name, _text(value)) for name, value in numbers.items()]
        lenses += _xml("calibration", resolution, *terms, **{"type": kind, "class": state})
    sensors, cameras = "", ""
    for number, image in enumerate(photos):
        name, pose = stem_of(image).upper(), np.eye(4)
        _copy(images / image.name, folder / "images" / ("left", "right")[number % 2] / f"{name}.JPG")
        pose[:3] = image.cam_from_world().inverse().matrix()
        place = (photos[0].cam_from_world() * image.cam_from_world().inverse()).matrix()
        of_rig = _xml("rotation", _text(place[:, :3])), _xml("location", _text(place[:, 3]))
        about = {"id": number, "label": "unknown", "type": kind} | ({"master_id": 0} if number else {})
        sensors += _xml("sensor", lenses, *(of_rig if number else ()), **about) if rig or not number else ""
        about, where = {"component_id": 0}, _xml("transform", _text(pose))
        if rig and number != 2:
            about, where = {"master_id": 2}, ""
        cameras += _xml("camera", where, id=number, sensor_id=number * rig, label=name, **about)
    cameras += _xml("camera", id=99, sensor_id=0, label="unaligned")
    world = (_xml(name, _text(it)) for name, it in (("rotation", TURN), ("translation", SHIFT), ("scale", SCALE)))
    component = _xml("components", _xml("component", _xml("transform", *world), id=0, label="Component 1"))
    parts = _xml("sensors", sensors), component, _xml("cameras", cameras)
    document = _xml("document", _xml("chunk", *parts, label="Chunk 1", enabled="true"), version="2.0.0")
    (folder / "cameras.xml").write_text('<?xml version="1.0" encoding="UTF-8"?>\n' + document)
    points = SCALE * points_of(model) @ TURN.T + SHIFT
    write_point_cloud(folder / "points3D.ply", points, np.full(points.shape, 90))
    return points


def _xml(tag: str, *content: str, **attributes: object) -> str:
    words = "".join(f' {name}="{value}"' for name, value in attributes.items())
    return f"<{tag}{words}>{''.join(content)}</{tag}>"


def _text(values: float | np.ndarray) -> str:
    return " ".join(repr(float(number)) for number in np.ravel(values))
