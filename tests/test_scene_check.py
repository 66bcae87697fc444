"""groundwork/finding: each fault of photos, cameras and points is named, and nothing is said of sound scenes."""

import argparse
import io
import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image
from scipy.ndimage import gaussian_filter
from synthetic import BROWN, HEIGHT, WIDTH, edit_json, make_blender_scene, make_colmap_scene, read

from applications.convert.images import find_masks, find_shared_pixels
from applications.convert.shared_masks import write_shared_masks
from groundwork.finding import Finding, Severity
from scene.checks.photo_files import _find_same_photos, check_blur
from scene.checks.photos import SHARED_TEXT, check_photos
from scene.checks.scene import check_dataset, findings, report
from scene.gaussians.copies import clusters_of
from scene.gaussians.start import start_rows
from scene.images.decode import decode
from scene.images.masks import MaskOptions
from scene.readers.depth_maps import with_depth_maps
from scene.readers.info import CameraInfo, SceneInfo, exposure_names, local, world_offset
from utils.graphics_utils import BasicPointCloud
from utils.system_utils import UserError

RANDOM = np.random.default_rng(0)
GREY = RANDOM.integers(0, 256, (48, 64)).astype(np.float64)
COLORS = RANDOM.integers(0, 256, (48, 64, 3)).astype(np.uint8)


def said(info: SceneInfo, **options) -> str:
    return "\n".join(str(one) for one in findings(info, **options))


def _with_photos(*photos: np.ndarray) -> SceneInfo:
    """A scene of photos in memory, with cameras in different places and no points."""
    views = [
        CameraInfo(n, np.eye(3), np.array([n, 0.0, 0]), FovX=1, FovY=1, image_name=f"v{n}", width=64, height=48,
                   image=Image.fromarray(photo))
        for n, photo in enumerate(photos)
    ]  # fmt: skip
    return SceneInfo(None, views, [], {"radius": 1.0}, None)


def _alpha(*values: float | np.ndarray) -> SceneInfo:
    return _with_photos(*(np.dstack([COLORS, np.broadcast_to(np.uint8(value), (48, 64))]) for value in values))


@pytest.mark.parametrize("part", ["centers", "moves", "points"])
@pytest.mark.parametrize(
    ("kept", "step"),
    [
        (lambda x: float(f"{x:.6g}"), "10"),
        (lambda x: float(f"{x:.8g}"), "0.1"),
        (lambda x: round(x, 1), "0.1"),
        (np.float32, "0.5"),
        (lambda x: float(f"{x:.10g}"), None),
        (float, None),
    ],
)
def test_rounded_coordinates_of_maps(kept, step, part):
    """Coordinates are those of cameras in transforms.json or COLMAP, or of points; heights are no large numbers."""
    found = _said_of_map((500123.4, 4649777.7, 312.3), 20, kept, part)
    what = "points" if part == "points" else "cameras"
    assert (f"coordinates are rounded: the {what} to steps of {step}, in a scene with" in found) == bool(step)
    assert ("are rounded" in found) == bool(step)


@pytest.mark.parametrize("place", [(1e4, 2e4, 30.0), (5000.0, 0.0, 0.0), (500123.4, 5300456.7, 212.0)])
def test_coordinates_far_from_the_origin_are_not_called_rounded(place):
    assert "are rounded" not in _said_of_map(place, 2, float, "centers")


def _said_of_map(place: tuple[float, float, float], spread: float, kept: Callable, part: str) -> str:
    """Findings on a scene at a place of a map. kept: rounds the coordinates of `part`."""
    random = np.random.default_rng(1)
    centers, points = place + random.normal(0, spread, (12, 3)), place + random.normal(0, spread, (500, 3))
    keep = {name: np.vectorize(kept if name == part else float) for name in ("centers", "moves", "points")}
    views = []
    for n, center in enumerate(keep["centers"](centers)):
        turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
        turn *= np.linalg.det(turn)
        move = keep["moves"](-turn.T @ center)
        views.append(CameraInfo(n, turn, move, FovX=1, FovY=1, image_name=f"v{n}", width=64, height=48,
                                image=Image.fromarray(COLORS)))  # fmt: skip
    cloud = BasicPointCloud(keep["points"](points), np.zeros((500, 3)), np.zeros((500, 3)))
    info = SceneInfo(cloud, views, [], {"radius": 1.0}, None)
    return said(local(info, world_offset(info)))


@pytest.mark.parametrize(
    ("info", "severe", "text"),
    [
        (_alpha(0, 0, 0), True, "3 of the 3 photos that were looked at show nothing, as every pixel"),
        (_alpha(1, 1), True, "left out by alpha; save the photos without alpha"),
        (_alpha(255, 0, 255), False, "1 of the 3 photos that were looked at (v1) show nothing"),
    ],
)  # fmt: skip
def test_photos(info, severe, text):
    (one,) = check_photos(info.train_cameras, 16)
    assert text in str(one) and (one.severity == Severity.HOPELESS) == severe


ROWS, COLUMNS = np.indices((48, 64))
CORNERS = np.minimum(ROWS, 47 - ROWS) + np.minimum(COLUMNS, 63 - COLUMNS) < 14
TEXTURE = np.random.default_rng(5).integers(0, 256, (12, 16, 3)).astype(np.uint8).repeat(4, 0).repeat(4, 1)


def _sharing(shared: np.ndarray, color: int | np.ndarray, count: int = 8) -> list[np.ndarray]:
    """Photos of `count` views, blurred and compressed, that have the pixels (48, 64) bool in common."""
    photos, rng = [], np.random.default_rng(3)
    for _ in range(count):
        photo = rng.integers(0, 256, (12, 16, 3)).astype(np.uint8).repeat(4, 0).repeat(4, 1)
        buffer = io.BytesIO()
        Image.fromarray(np.where(shared[..., None], color, photo).astype(np.uint8)).save(
            buffer, "JPEG", quality=95, subsampling=0
        )
        photos.append(np.asarray(Image.open(buffer)))
    return photos


def _before(background: int, size: int = 16) -> list[np.ndarray]:
    """Photos of a thing that turns before a plain background."""
    photos, rng = [], np.random.default_rng(4)
    for angle in np.linspace(0, np.pi, 12):
        x, y = COLUMNS - 32, ROWS - 24
        inside = ((np.cos(angle) * x + np.sin(angle) * y) / size) ** 2 + (
            (np.cos(angle) * y - np.sin(angle) * x) / 9
        ) ** 2
        photos.append(np.where(inside[..., None] < 1, rng.integers(0, 256, (48, 64, 3)), background).astype(np.uint8))
    return photos


@pytest.mark.parametrize(
    ("photos", "text"),
    [
        (_sharing(CORNERS, 0), "13% of each photo, in the corners, is the same in nearly all photos"),
        (
            _sharing((ROWS - 24) ** 2 + (COLUMNS - 32) ** 2 > 23**2, 0),
            "of each photo, at the top and left and right, is",
        ),
        (_sharing(ROWS >= 40, TEXTURE), "17% of each photo, at the bottom, is"),
        ([np.where(photo == 7, TEXTURE, photo) for photo in _before(7)], "is the same"),  # a turntable
        (_sharing(ROWS >= 40, TEXTURE)[:4], ""),  # few photos
        (_sharing(ROWS >= 40, TEXTURE)[:2] * 6, ""),  # bursts
        (_before(255), ""),
        (_sharing(ROWS < 0, 0), ""),
        ([np.dstack([photo, np.uint8(255 * ~CORNERS)]) for photo in _sharing(CORNERS, TEXTURE)], ""),  # transparent
    ],
)
def test_pixels_that_all_photos_share(photos, text):
    found = "\n".join(str(one) for one in check_photos(_with_photos(*photos).train_cameras, 16))
    assert text in found and ("is the same" in found) == bool(text)


def test_training_and_doctor_name_one_share_of_shared_pixels():
    """A few photos lack a part of the caption, so that the share depends on which photos are looked at."""
    whole = _with_photos(*_sharing(ROWS >= 40, TEXTURE, 5), *_sharing(ROWS >= 32, TEXTURE, 35))
    views = whole.train_cameras
    shares = [said(whole, most=100), said(whole._replace(train_cameras=views[1::2], test_cameras=views[::2]))]
    assert "of each photo, at the bottom, is the same" in shares[0] and shares[0] == shares[1]


def test_other_faults_wait_for_shared_pixels(scene, monkeypatch):
    """Photos with a caption do not fit their points, either. Masks by the command that is named end the fault."""
    for path in (scene / "images").rglob("*.png"):
        photo = np.asarray(Image.open(path)).copy()
        photo[40:] = TEXTURE.repeat(2, 0).repeat(2, 1)[: HEIGHT - 40, :WIDTH]
        Image.fromarray(photo).save(path)
    lines = [line for line in check_dataset(str(scene), "images") if line.is_problem]
    texts = [line.text for line in lines]
    assert texts[:2] == ["only 17 photos", "only 300 points to start from; 1000 or more are good"]
    assert "of each photo, at the bottom" in texts[2] and len(texts) == 3
    write_shared_masks(*map(Path, shlex.split(lines[-1].remedy.split("`")[1])[-2:]))
    assert SHARED_TEXT not in str(check_dataset(str(scene), "images", MaskOptions("images_masks")))
    monkeypatch.setattr("scene.checks.photos.has_application", lambda name: False)
    (without,) = [line.remedy for line in check_dataset(str(scene), "images") if SHARED_TEXT in line.text]
    assert without == "mask it, and pass the folder of the masks as --masks of train.py"


@pytest.mark.parametrize("turned", [False, True])
def test_masks_of_shared_pixels(tmp_path, turned):
    """They are of the upright photos, and end the warning."""
    exif = Image.Exif()
    exif[0x0112] = 6
    (tmp_path / "input" / "a").mkdir(parents=True)
    names = [f"a/{n}.png" for n in range(8)]
    for name, photo in zip(names, _sharing(ROWS >= 40, TEXTURE), strict=True):
        image = Image.fromarray(photo)
        image = image.transpose(TURNS[6]) if turned else image
        image.save(tmp_path / "input" / name, exif=exif if turned else None)
    assert write_shared_masks(tmp_path / "input", tmp_path / "masks") == 8
    masks = find_masks(names, tmp_path / "masks", tmp_path / "input")
    for mask in masks.values():
        kept = np.asarray(Image.open(mask))
        assert kept[:37].all() and not kept[40:].any()
    assert find_shared_pixels(tmp_path / "input", names, masks, tmp_path) == []
    (found,) = find_shared_pixels(tmp_path / "input", names, {}, tmp_path)
    assert "17% of each photo, at the bottom, is the same" in found.text
    with pytest.raises(UserError, match="no pixels that nearly all photos in .* share"):
        write_shared_masks(tmp_path / "masks", tmp_path / "other")
    with pytest.raises(UserError, match="no folder .*nowhere; name the folder of the photos"):
        write_shared_masks(tmp_path / "nowhere", tmp_path / "other")
    with pytest.raises(UserError, match="would count as photos of"):
        write_shared_masks(tmp_path / "input", tmp_path / "input" / "masks")


def test_blurred_photos_are_named_whatever_they_show(sound, tmp_path):
    """Also if half of them are: from rich to plain, bright to dark, small to large, and in any direction."""
    rng, views = np.random.default_rng(1), []
    for n, view in enumerate(read(sound).train_cameras[:8]):
        texture = sum(s * gaussian_filter(rng.normal(size=(300, 400, 3)), (s, s, 0)) for s in (0.6, 2, 4, 8))
        wall = texture * 60 * 0.97**n + 150 - 10 * n
        moved = np.mean(
            [
                np.roll(wall, (round(k * np.sin(n * np.pi / 6)), round(k * np.cos(n * np.pi / 6))), (0, 1))
                for k in range(16)
            ],
            0,
        )
        pixels = Image.fromarray((moved if n % 2 else wall).clip(0, 255).astype(np.uint8))
        path = tmp_path / f"{n}.png"
        (pixels.crop((0, 0, 200, 200)) if n > 5 else pixels).save(path)
        views.append(replace(view, image_path=path, image_name=path.name))
    info = read(sound)._replace(train_cameras=views)
    (found,) = check_blur(info, 100)
    assert found.text == "4 of the 8 photos that were checked look blurred (1.png, 3.png, 5.png, 7.png)"
    assert [*check_blur(info._replace(train_cameras=views[::2]), 100)] == [*check_blur(_with_photos(COLORS), 9)] == []


def test_sound_photos_are_passed():
    edges = np.where(np.indices((48, 64))[1] < 30, 255, 0) + np.where(np.indices((48, 64))[1] == 30, 100, 0)
    for info in (_with_photos(COLORS), _with_photos((GREY * 257).astype(np.uint16)), _alpha(edges, 255)):
        assert said(info) == ""
    assert said(_alpha(0, 0), options=argparse.Namespace(mask_meaning="none")) == ""


@pytest.fixture(scope="module")
def sound(_colmap_master: Path) -> Path:
    return _colmap_master


@pytest.fixture
def scene(sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy, whose turned photos get a cache of their own."""
    monkeypatch.setenv("GS_CACHE", str(tmp_path / "cache"))
    return Path(shutil.copytree(sound, tmp_path / "scene"))


def _cameras(info: SceneInfo, **fields) -> SceneInfo:
    return info._replace(train_cameras=[replace(view, **fields) for view in info.train_cameras])


def test_a_sound_scene_is_passed(sound):
    for hold_out in (False, True):
        assert findings(read(sound, hold_out)) == []


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"fx": 1.2, "fy": 1.7}, "a focal length of 1.2 pixels); give focal lengths in pixels (these may be in parts"),
        ({"fx": 6.0, "fy": 6.0}, "these may be in millimetres"),
        ({"fx": 5000.0, "fy": 5000.0}, "odd opening angles of 17 cameras"),
        ({"cx": 0.5, "cy": 0.5}, "principal point of 17 cameras is in a corner or at an edge"),
        ({"cx": 192.0, "cy": 128.0}, "principal point of 17 cameras is in a corner or at an edge"),
        ({"fy": 300.0}, "focal lengths in x and y of 17 cameras differ more than twofold"),
    ],
)
def test_cameras(sound, fields, text):
    assert text in said(_cameras(read(sound), **fields))
    assert "principal" not in said(_cameras(read(sound), cx=-900.0))  # a part of a large photo


TURNS = {
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_90,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_270,
}  # what a device with this orientation did to the upright picture


def lie_down(scene: Path, orientation: int, turn: Image.Transpose) -> None:
    for path in scene.rglob("*.png"):
        turned = Image.open(path).transpose(turn)
        exif = turned.getexif()
        exif.update({0x0112: orientation, 0x010F: "maker"})
        turned.save(path, exif=exif)


@pytest.mark.parametrize("kind", ["as they are", "upside down", "TIFF"])
def test_photos_turned_against_their_camera_are_refused(scene, kind):
    """Pillow turns TIFF files itself: cameras are of the files as they are, so that what it reads lies on its side."""
    if kind == "TIFF":
        for path in (scene / "images").rglob("*.png"):
            Image.open(path).save(path, format="TIFF", tiffinfo={0x0112: 6})
    else:
        lie_down(scene, 3 if kind == "upside down" else 1, Image.Transpose.ROTATE_90)
    with pytest.raises(UserError, match=r"17 of 17 photos have the sides .* \(64 x 96, camera 96 x 64\); turn"):
        read(scene)


@pytest.mark.parametrize("orientation", TURNS)
def test_photos_that_exif_turns_are_made_upright(scene, sound, tmp_path, capsys, orientation):
    """Also the second time, where a copy in the cache was cut short."""
    lie_down(scene, orientation, TURNS[orientation])
    for _ in range(2):
        for view, upright in zip(read(scene).train_cameras, read(sound).train_cameras, strict=True):
            assert view.file_size == upright.file_size == (96, 64)
            assert torch.equal(decode(view.image_path, (96, 64)), decode(upright.image_path, (96, 64)))
            assert dict(Image.open(view.image_path).getexif()) == {0x010F: "maker"}
        said = capsys.readouterr().err
        assert "17 of 17 photos are turned as their EXIF orientation says" in said and str(tmp_path / "cache") in said
        cut = next((tmp_path / "cache" / "turned").iterdir())
        cut.write_bytes(cut.read_bytes()[:-40])


def test_photos_of_distorting_lenses_are_turned_before_they_are_undistorted(tmp_path, monkeypatch):
    monkeypatch.setenv("GS_CACHE", str(tmp_path / "cache"))
    make_colmap_scene(tmp_path / "sound", model="OPENCV", params=BROWN, views=3)
    scene = Path(shutil.copytree(tmp_path / "sound", tmp_path / "scene"))
    lie_down(scene, 6, TURNS[6])
    for view, upright in zip(read(scene).train_cameras, read(tmp_path / "sound").train_cameras, strict=True):
        assert (view.fx, view.fy, view.cx, view.cy) == (upright.fx, upright.fy, upright.cx, upright.cy)
        size = view.file_size
        assert torch.equal(decode(view.image_path, size), decode(upright.image_path, size))


def test_turned_photos_keep_their_names_even_if_equal(tmp_path, monkeypatch):
    """Blender's r_0 of both folders: for depth maps, exposures, and the split."""
    monkeypatch.setenv("GS_CACHE", str(tmp_path / "cache"))
    make_blender_scene(tmp_path)
    for split in ("train", "test"):
        edit_json(tmp_path / f"transforms_{split}.json", lambda content: content.update(w=40, h=30, fl_x=50, fl_y=50))
        lie_down(tmp_path / split, 8, TURNS[8])
        for path in (tmp_path / split).iterdir():
            (tmp_path / "depths" / split).mkdir(parents=True, exist_ok=True)
            Image.new("I;16", (40, 30), 3000).save(tmp_path / "depths" / split / path.name)
    found = with_depth_maps(read(tmp_path, hold_out=True), tmp_path, "depths").train_cameras
    assert [Path(view.depth_path).name for view in found] == [f"r_{n}.png" for n in range(4)]
    names = exposure_names(read(tmp_path).train_cameras)
    assert names[:2] == ["train/r_0.png", "train/r_1.png"] and len({*names}) == 6


@pytest.mark.parametrize(
    ("exif", "turned"),
    [
        (b"Exif\0\0garbage", False),
        (b"Exif\0\0II*\0\x08\0\0\0\x02\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0"
         b"\x1a\x01\x02\0\x02\0\0\0a\0\0\0\0\0\0\0", True),  # the resolution is a text
    ],
)  # fmt: skip
def test_damaged_exif_data_are_no_fault_of_a_photo(scene, exif, turned):
    for path in (scene / "images").rglob("*.png"):
        Image.open(path).transpose(TURNS[6]).save(path, exif=exif)
    if turned:
        assert {view.file_size for view in read(scene).train_cameras} == {(96, 64)}
    else:
        with pytest.raises(UserError, match="17 of 17 photos have the sides of their camera exchanged"):
            read(scene)


def test_masks_that_lie_like_their_turned_photos_are_told(scene):
    lie_down(scene, 6, TURNS[6])
    shutil.copytree(scene / "images", scene / "masks")
    for path in (scene / "masks").rglob("*.png"):
        Image.new("L", (64, 96), 255).save(path)
    with pytest.raises(UserError, match="its photo 96 x 64 when upright; make masks of the same shape as the upright"):
        read(scene, masks=MaskOptions("masks"))


@pytest.mark.parametrize("apart", [0.0, 1e-6])
@pytest.mark.parametrize("size", [0.1, 1.0, 1000.0])
def test_points_that_are_there_several_times(apart, size):
    """Sizes are those of the cloud without copies, which at a few borders of cells are some percent off."""
    points = RANDOM.normal(size=(2000, 3)).astype(np.float32) * np.float32(size)
    copies = np.concatenate([points] * 4) + RANDOM.normal(scale=apart * size, size=(8000, 3)).astype(np.float32)
    assert clusters_of(copies).hides_spacing and not clusters_of(points).hides_spacing
    scales = [
        start_rows(BasicPointCloud(x, x, x), size, 0)["scaling"][:2000, 0].exp().numpy() for x in (points, copies)
    ]
    np.testing.assert_allclose(np.median(scales[1] / scales[0]), 1, rtol=1e-3)
    assert (np.abs(scales[1] / scales[0] - 1) < 0.3).mean() > 0.98


def test_a_few_pairs_change_nothing(sound):
    """Structure from motion leaves some: the bytes of trainings that start from them are kept."""
    info = read(sound)
    points = info.point_cloud.points
    pairs = BasicPointCloud(*(np.concatenate([values, values[:20]]) for values in info.point_cloud))
    assert not clusters_of(pairs.points).hides_spacing and said(info._replace(point_cloud=pairs)) == ""
    four = BasicPointCloud(*(np.concatenate([values] * 4) for values in info.point_cloud))
    lines = said(info._replace(point_cloud=four))
    assert f"100% of the {4 * len(points)} points share a place with others, up to 4 in one" in lines


def test_photos_that_are_there_twice(sound, tmp_path):
    info = read(sound)
    first, second = info.train_cameras[:2]
    copy = tmp_path / "copy.png"
    shutil.copyfile(first.image_path, copy)
    twin = replace(first, image_path=copy, image_name="copy.png")
    for again in (first, twin):
        assert "photos are there twice (" in said(info._replace(train_cameras=[*info.train_cameras, again]))
        leaked = info._replace(test_cameras=[again])
        assert f"1 of 1 test photos also train ({again.image_name}), so their scores" in said(leaked)
        assert said(leaked, halves=True) == ""
    elsewhere = [replace(twin, R=second.R, T=second.T), *info.train_cameras]
    assert "the same picture belongs to cameras in different places (" in said(info._replace(train_cameras=elsewhere))
    same = [replace(view, image_path=copy) for view in info.train_cameras]
    assert "all 17 photos are the same picture" in said(info._replace(train_cameras=same))


SCENES = (
    *("bonsai_full", "bonsai_small", "fox_full", "fox_raw", "fox_tiny", "monstree_mixed", "monstree_raw"),
    *("nerf_lego200_tiny", "nerf_lego400", "tt_train"),
)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_published_scenes_are_passed(shared_dir, name):
    """By the doctor, but for the number of photos where these are a part of a scene, and by a training."""
    scene = shared_dir / "scenes" / name
    wrong = [one.text for one in check_dataset(str(scene), "images") if one.is_problem]
    assert wrong == [f"only {count} photos" for part, count in (("fox_raw", 12), ("monstree_raw", 9)) if part == name]
    assert findings(read(scene, hold_out=True)) == []


def test_what_a_training_prints(capsys):
    found = [Finding(f"fault {n}", "repair it") for n in range(7)]
    report(found, "garden")
    lines = capsys.readouterr().err.splitlines()
    assert lines == [*(f"warning: fault {n}; repair it" for n in range(5)), "2 more: python doctor.py -s garden"]
    with pytest.raises(UserError, match="fault; repair it"):
        report([Finding("fault", "repair it", Severity.HOPELESS), *found], "garden")


def _longer(model) -> None:
    for camera in model.cameras.values():
        camera.params = [1.3 * value for value in camera.params[:2]] + [*camera.params[2:]]


def _farther(model) -> None:
    for point in model.points3D.values():
        point.xyz = 10 * point.xyz


@pytest.mark.parametrize(
    ("change", "text"), [(_longer, "with focal lengths 0.769 times as long"), (_farther, "if those are scaled by 0.1")]
)
def test_a_geometric_cause_is_named(scene, change, text):
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    change(model)
    model.write_binary(str(scene / "sparse" / "0"))
    assert text in "\n".join(line.text for line in check_dataset(str(scene), "images") if line.is_problem)


def test_records_of_other_readers_are_judged(sound):
    """They may lack what our records have besides the reference's fields."""
    info, names = read(sound), CameraInfo._fields
    plain = [argparse.Namespace(**{name: getattr(view, name) for name in names}) for view in info.train_cameras]
    plain[0].FovX = 3.1
    assert "odd opening angles of 1 camera (" in said(info._replace(train_cameras=plain))


def test_photos_that_differ_between_what_is_compared_first_are_two(sound, tmp_path):
    """Photos without compression of a thing that moves a little share much."""
    views = []
    for number, view in enumerate(read(sound).train_cameras[:2]):
        content = bytearray(4 << 20)
        content[1 << 20] = number
        path = tmp_path / f"{number}.bmp"
        path.write_bytes(content)
        views.append(replace(view, image_path=path))
    assert [*_find_same_photos(views)] == [[0], [1]]
    views[1].image_path.write_bytes(views[0].image_path.read_bytes())
    assert [*_find_same_photos(views)] == [[0, 1]]
