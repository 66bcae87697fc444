"""nerfstudio and instant-ngp folders: the views of the COLMAP model that they were made from, and intrinsics."""

import json
import math
import os
import shutil
import unicodedata
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from synthetic import FakeGaussians, edit_json, folder_state, make_nerfstudio_scene, options_of, read

from scene import Scene
from scene.dataset_readers import read_scene
from scene.images.lens import Lens
from scene.readers.transforms import read_poses
from scene.readers.transforms_lens import lens_of
from utils.system_utils import UserError


@pytest.fixture
def scene(tmp_path) -> Path:
    make_nerfstudio_scene(tmp_path / "scene")
    shutil.move(tmp_path / "scene" / "sparse", tmp_path / "colmap" / "sparse")
    return tmp_path / "scene"


def _edit(scene: Path, change) -> None:
    edit_json(scene / "transforms.json", change)


@pytest.mark.parametrize("distorted", [False, True])
def test_views_are_those_of_the_colmap_model(tmp_path, distorted):
    folder = tmp_path / "scene"
    make_nerfstudio_scene(folder, distorted=distorted, views=9)
    colmap = read(folder, hold_out=True)
    shutil.rmtree(folder / "sparse")
    before = folder_state(folder)
    info = read(folder, hold_out=True)
    for mine, theirs in ((info.train_cameras, colmap.train_cameras), (info.test_cameras, colmap.test_cameras)):
        assert [camera.image_name for camera in mine] == [f"images/{camera.image_name}" for camera in theirs]
        for a, b in zip(mine, theirs, strict=True):
            np.testing.assert_allclose(a.R, b.R, atol=1e-12)
            np.testing.assert_allclose(a.T, b.T, atol=1e-12)
            assert (a.fx, a.fy, a.cx, a.cy, a.width, a.height) == (b.fx, b.fy, b.cx, b.cy, b.width, b.height)
            assert a.image_path == b.image_path  # undistorted once
    assert info.extent == pytest.approx(colmap.extent)
    assert len(info.point_cloud.points) == 300 and info.ply_path == folder / "sparse_pc.ply"
    Scene(options_of(folder, tmp_path / "out"), FakeGaussians()).getTrainCameras()[0].target(torch.zeros(3))
    assert folder_state(folder) == before


def test_every_kind_of_scene_opens_by_itself(scene, blender_scene, colmap_scene):
    names = [read(folder).train_cameras[0].image_name for folder in (colmap_scene, blender_scene, scene)]
    assert names == ["Right/V03.png", "r_0", "images/Right/V03.png"]
    shutil.copytree(blender_scene, scene, dirs_exist_ok=True)
    assert read(scene).train_cameras[0].image_name == "r_0"  # Blender's files before nerfstudio's
    shutil.copytree(colmap_scene / "sparse", scene / "sparse")
    assert read(scene).train_cameras[0].image_name == "Right/V03.png"  # COLMAP before both


def test_split_lists(scene):
    names = [camera.image_name for camera in read(scene).train_cameras]
    lists = {"train_filenames": names[:10], "val_filenames": [f"./{names[10]}"], "test_filenames": names[12:14]}
    _edit(scene, lambda content: content.update(lists))
    info = read(scene, hold_out=True)
    assert [c.image_name for c in info.train_cameras] == names[:10]
    assert [c.image_name for c in info.test_cameras] == names[12:14]
    assert len(read(scene).train_cameras) == 17
    _edit(scene, lambda content: (content.pop("test_filenames"), content.pop("train_filenames")))
    info = read(scene, hold_out=True)
    assert [c.image_name for c in info.test_cameras] == [names[10]] and len(info.train_cameras) == 16
    _edit(scene, lambda content: content.update(test_filenames=["elsewhere.png"]))
    with pytest.raises(UserError, match="17 are in train_filenames and 0 in test_filenames"):
        read(scene, hold_out=True)
    _edit(scene, lambda content: content.update(test_filenames=7))
    with pytest.raises(UserError, match="test_filenames in .*must be a list"):
        read(scene, hold_out=True)


@pytest.mark.parametrize(
    "spelled",
    [
        lambda name: f".\\{name.upper()}",
        lambda name: unicodedata.normalize("NFD", name),
        lambda name: name.removesuffix(".png"),
        lambda name: name.replace("images", "images/../images").replace(".png", ".JPG"),
    ],
)
def test_split_lists_match_as_photos_are_found(scene, capsys, spelled):
    names = [camera.image_name for camera in read(scene).train_cameras]
    accented = str(Path(names[0]).with_name("Früh.png"))
    (scene / names[0]).rename(scene / accented)

    def change(content):
        for frame in content["frames"]:
            if os.path.normpath(frame["file_path"]) == names[0]:
                frame["file_path"] = accented
        train = [spelled(name) for name in names[4:]]
        content |= {"train_filenames": [*train, "images/lost.png"], "test_filenames": [spelled(accented)]}

    _edit(scene, change)
    capsys.readouterr()
    info = read(scene, hold_out=True)
    assert [view.image_name for view in info.test_cameras] == [accented]
    assert [view.image_name for view in info.train_cameras] == names[4:]
    said = capsys.readouterr().err
    assert "1 entries of the lists" in said and "match no photo of its frames: images/lost.png" in said
    assert "3 photos of" in said and f"are left out: {names[1]}, {names[2]}" in said


@pytest.mark.parametrize("again", [0, 3])
def test_test_frames_are_the_test_views(scene, capsys, again):
    """Also where some of them are among the frames, as a copy or by another way to write their path."""
    names = sorted(camera.image_name for camera in read(scene).train_cameras)

    def move(content):
        frames = sorted(content["frames"], key=lambda frame: frame["file_path"].removeprefix("./"))
        test = frames[::4]
        twins = [{**frame, "file_path": "images/../" + frame["file_path"]} for frame in test[:again]]
        content.update(frames=[frame for frame in frames if frame not in test] + twins, test_frames=test)

    _edit(scene, move)
    info = read(scene, hold_out=True)
    assert [Path(view.image_path).resolve() for view in info.test_cameras] == [scene / name for name in names[::4]]
    train = {Path(view.image_path).resolve() for view in info.train_cameras}
    assert train == {scene / name for name in set(names) - set(names[::4])}
    assert (f"{again} frames of" in capsys.readouterr().err) == bool(again)
    assert len(read(scene).train_cameras) == 17


def test_a_photo_has_one_pose(scene, capsys):
    _edit(scene, lambda content: content["frames"].append(content["frames"][0]))
    assert len(read(scene).train_cameras) == 17
    assert "1 frames of" in capsys.readouterr().err

    def moved(content):
        content["frames"][-1]["transform_matrix"][0][3] += 0.1

    _edit(scene, moved)
    with pytest.raises(UserError, match=r"lists the photo .* twice, with different poses; keep one"):
        read(scene)


@pytest.mark.parametrize("panorama", [{"camera_model": "latlong"}, {"latlong": True}, {"camera_model": "LATLONG"}])
def test_panoramas_of_instant_ngp(panorama):
    assert lens_of(panorama, {"fl_x": 3.0}, (64, 32), Path("a.json")) == Lens("EQUIRECTANGULAR", (64, 32), 64, 32)


@pytest.mark.parametrize("lens", [{"ftheta_p1": 0.1}, {"equirectangular": True}, {"orthographic": True}])
def test_other_lenses_of_instant_ngp_are_refused(lens):
    with pytest.raises(UserError, match=f"a.json has {next(iter(lens))}, a lens .*cannot be used; convert"):
        lens_of(lens, {"fl_x": 30.0}, (64, 32), Path("a.json"))


@pytest.mark.parametrize(("encoding", "slash"), [("utf-8-sig", "\\"), ("utf-16", "\\\\")])
def test_camera_files_of_windows(scene, encoding, slash):
    """A lone backslash is no JSON, or an escape: of images\\new.png the letter n."""
    names = [camera.image_name for camera in read(scene).train_cameras]
    text = (scene / "transforms.json").read_text().replace("./images", "images")
    content = json.loads(text)
    for frame in content["frames"]:
        text = text.replace(frame["file_path"], frame["file_path"].replace("/", slash))
    (scene / "transforms.json").write_text(text, encoding=encoding)
    assert [camera.image_name for camera in read(scene).train_cameras] == names
    shutil.copy(scene / names[0], scene / "images" / "new.png")  # whose backslash makes an escape
    frame = {**content["frames"][0], "file_path": "images\new.png"}
    (scene / "transforms.json").write_text(json.dumps({**content, "frames": [frame]}))
    assert [camera.image_name for camera in read(scene).train_cameras] == ["images/new.png"]


@pytest.mark.parametrize("name", ["points3D.ply", "points3d.ply", "Points3D.PLY"])
def test_points_beside_the_camera_file(scene, blender_scene, name):
    shutil.copy(scene / "sparse_pc.ply", blender_scene / name)
    (scene / "sparse_pc.ply").rename(scene / name)
    _edit(scene, lambda content: content.pop("ply_file_path"))
    for folder in (scene, blender_scene):
        info = read(folder)
        assert len(info.point_cloud.points) == 300 and info.ply_path == folder / name
    _edit(scene, lambda content: content.update(ply_file_path=f".\\{name.upper()}"))
    assert len(read(scene).point_cloud.points) == 300


def test_masks_of_frames(scene):
    (scene / "masks").mkdir()
    grey = np.full((64, 96), 255, np.uint8)
    grey[:32] = 0
    Image.fromarray(grey).save(scene / "masks" / "one.png")
    _edit(scene, lambda content: content["frames"][3].update(mask_path="masks/one.png"))
    name = json.loads((scene / "transforms.json").read_text())["frames"][3]["file_path"].removeprefix("./")
    cameras = {camera.image_name: camera for camera in read(scene).train_cameras}
    assert [n for n, camera in cameras.items() if camera.mask] == [name]
    views = Scene(options_of(scene, scene.parent / "out"), FakeGaussians()).getTrainCameras()
    (mask,) = [view.counted_pixels for view in views if view.counted_pixels is not None]
    assert mask.shape == (1, 64, 96) and mask[:, 32:].all() and not mask[:, :32].any()
    _edit(scene, lambda content: content["frames"][3].update(mask_path="masks/two.png"))
    with pytest.raises(UserError, match=r"1 of 1 masks that .*transforms.json lists are missing"):
        read(scene)
    _edit(scene, lambda content: content["frames"][3].update(mask_path=content["frames"][3]["file_path"]))
    with pytest.raises(UserError, match="frame 4 .* names the photo itself as its mask .*; name a mask file, or take"):
        read(scene)


@pytest.mark.parametrize("native", [False, True])
def test_the_circle_of_a_fisheye_is_a_mask(scene, native, capsys):
    """Each photo gets the circle, also beside its own mask, whose black half stays masked. Readers of poses say so."""
    grey = np.full((64, 96), 255, np.uint8)
    grey[:, :48] = 0
    Image.fromarray(grey).save(scene / "mask.png")

    def change(content):
        content |= {"fisheye_crop_radius": 24, "w": 96, "h": 64, "k1": 0.0 if native else 1e-6}
        content["frames"][0].update(mask_path="mask.png")
        content["frames"][1].update(fisheye_crop_radius=None)

    _edit(scene, change)
    views = {view.image_name: view for view in read(scene, native=native).train_cameras}
    own, without, *others = (
        views[os.path.normpath(frame["file_path"])]
        for frame in json.loads((scene / "transforms.json").read_text())["frames"]
    )
    kept = [view.mask.decode((view.width, view.height))[0].numpy() == 255 for view in (own, *others)]
    assert kept[0].sum() == pytest.approx(np.pi * 24**2 / 2, rel=0.1) and not kept[0][:, :46].any()
    for one in kept[1:]:
        assert one.sum() == pytest.approx(np.pi * 24**2, rel=0.08) and one[12:50, 40:56].all()
        assert not native or one.sum() == (np.hypot(*(np.mgrid[-31.5:32, -47.5:48])) <= 24).sum()
    assert without.mask is None or without.mask.decode((96, 64)).all()
    assert "not used" not in capsys.readouterr().err
    read_poses(scene / "transforms.json")
    assert "transforms.json that are not used: fisheye_crop_radius, mask_path\n" in capsys.readouterr().err
    _edit(scene, lambda content: content.update(fisheye_crop_radius=-3))
    with pytest.raises(UserError, match="fisheye_crop_radius in .*transforms.json must be .* above 0, got -3"):
        read(scene)


def test_no_points(scene):
    _edit(scene, lambda content: content.pop("ply_file_path"))
    with pytest.raises(UserError, match="names no points .*--init_type random"):
        read(scene)
    assert len(read(scene, init_type="random").point_cloud.points) == 100_000
    _edit(scene, lambda content: content.update(ply_file_path="gone.ply"))
    with pytest.raises(UserError, match="no point cloud .*gone.ply"):
        read(scene)


def _lens(fields: dict, shared: dict | None = None) -> Lens:
    return lens_of(fields, shared or {}, (200, 100), Path("transforms.json"))


FLAT, K, FISH = (90, 90, 100, 50), {"k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4}, "OPENCV_FISHEYE"


@pytest.mark.parametrize(
    ("fields", "model", "params"),
    [
        ({}, "PINHOLE", FLAT),
        ({"camera_model": "OPENCV", "k1": 0.0}, "PINHOLE", FLAT),
        ({"camera_angle_x": 1, "fl_y": 80, "cx": 7, "cy": 8}, "PINHOLE", (90, 80, 7, 8)),
        ({"k1": 0.1, "p2": 0.2}, "OPENCV", (*FLAT, 0.1, 0, 0, 0.2)),
        ({"camera_model": "SIMPLE_RADIAL", "k1": 0.1}, "OPENCV", (*FLAT, 0.1, 0, 0, 0)),
        (K | {"camera_model": "OPENCV", "k4": 0, "p1": 0.4, "p2": 0.5}, "FULL_OPENCV",
         (*FLAT, 0.1, 0.2, 0.4, 0.5, 0.3, 0, 0, 0)),
        (K | {"camera_model": FISH}, FISH, (*FLAT, 0.1, 0.2, 0.3, 0.4)),
        ({"is_fisheye": True, "k1": 0.1}, FISH, (*FLAT, 0.1, 0, 0, 0)),
        ({"fl_y": 90, "camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR", (200, 100)),
        ({"distortion_params": [0.1, 0.2, 0, 0, 0.3, 0.4]}, "OPENCV", (*FLAT, 0.1, 0.2, 0.3, 0.4)),
        ({"is_fisheye": True, "distortion_params": [0.1, 0.2, 0.3, 0.4, 0, 0]}, FISH, (*FLAT, 0.1, 0.2, 0.3, 0.4)),
        ({"camera_model": FISH, "k1": 0.1, "k3": 0.3, "p1": 0.5, "p2": 0.6}, "THIN_PRISM_FISHEYE",
         (*FLAT, 0.1, 0, 0.5, 0.6, 0.3, 0, 0, 0)),
        ({"camera_model": "FISHEYE624", "distortion_params": [n / 100 for n in range(12)]},
         "RAD_TAN_THIN_PRISM_FISHEYE", (*FLAT, *(n / 100 for n in range(12)))),
    ],
)  # fmt: skip
def test_intrinsics(fields, model, params):
    fields = {"fl_x": 90} | fields
    shared = {"fl_x": 1, "k1": 9, "cx": 1} if "k1" in fields else None
    for lens in (_lens(fields), _lens({}, fields), _lens(fields, shared)):
        assert lens.model == model and (lens.width, lens.height) == (200, 100)
    np.testing.assert_allclose(_lens(fields).params, params, rtol=1e-12)
    right_angle = {"camera_angle_x": math.pi / 2}
    assert _lens(right_angle).params[:2] == pytest.approx((100, 100))
    assert _lens(right_angle | {"camera_angle_y": math.pi / 2}).params[:2] == pytest.approx((100, 50))


def test_listed_distortion_gives_way_to_the_terms_of_a_frame():
    listed = {"fl_x": 90, "k1": 9.0, "distortion_params": [0.1, 0.2, 0, 0, 0, 0]}
    assert _lens({"k1": 0.5}, listed).params[4:6] == (0.5, 0.2) and _lens({}, listed).params[4:6] == (0.1, 0.2)
    for wrong in ([0.1, 0.2], [0.0] * 12, {"k1": 1}, "0.1"):
        with pytest.raises(UserError, match="distortion_params in transforms.json must be a list of 6 numbers, k1 k2"):
            _lens({"distortion_params": wrong}, listed)


def test_frames_have_their_own_intrinsics(scene, blender_scene):
    _edit(scene, lambda content: content["frames"][0].update(fl_x=77.0, cx=40.0))
    cameras = read(scene).train_cameras
    assert sorted({(camera.fx, camera.fy, camera.cx) for camera in cameras}) == [(77, 110, 40), (110, 110, 45)]

    def change(content):
        content["frames"][1] |= {"fl_x": 33.0, "cx": 18.0}
        content["fl_y"] = 31.0

    edit_json(blender_scene / "transforms_train.json", change)
    cameras = read(blender_scene).train_cameras
    assert (cameras[1].fx, cameras[1].fy, cameras[1].cx, cameras[1].cy) == (33, 31, 18, 15)
    assert (cameras[0].FovX, cameras[0].fy) == (pytest.approx(0.7), 31)


@pytest.mark.parametrize("place", ["images_4", "../resized_images", "photos"])
def test_photos_in_another_folder_than_the_file_names(scene, place):
    """Find photos as DL3DV and ScanNet++ have them, or as -i says; also those of lists of training and test photos."""
    names = [f"images/{path.relative_to(scene / 'images')}" for path in sorted((scene / "images").rglob("*.png"))]
    edit_json(
        scene / "transforms.json", lambda content: content.update(train_filenames=names[4:], test_filenames=names[:4])
    )
    whole = read(scene, hold_out=True)
    for path in (scene / "images").rglob("*.png"):
        Image.open(path).resize((48, 32)).save(path)
    (scene / "images").rename(scene / place)
    (scene / "images").mkdir()
    images = place if place == "photos" else "images"
    info = read_scene(scene, images, hold_out=True)
    assert [view.image_name for view in info.test_cameras] == [
        name.image_name.replace("images", place, 1) for name in whole.test_cameras
    ]
    (view, *_), first = info.train_cameras, whole.train_cameras[0]
    assert view.fx / view.width == pytest.approx(first.fx / first.width) and len(info.train_cameras) == 13
    with pytest.raises(
        UserError, match="17 of 17 photos that .* lists are not in the folder of -i images_2: .*leave -i"
    ):
        read_scene(scene, "images_2", hold_out=True)
