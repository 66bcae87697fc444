"""Undistortion of every camera model of pycolmap: positions in the image, files in the cache, pixels that count.

The reference is pycolmap's own projection of each model.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from lenses import DISTORTED, DISTORTIONS, colmap_camera, make_lens
from PIL import Image
from synthetic import FakeGaussians, folder_state, make_colmap_scene, options_of, read

from scene import Scene
from scene.images.decode import picture_size
from scene.images.lens import WIDEST, Lens, pinhole_of, undistortion, visible_pixels
from scene.images.masks import TRANSPARENT, Mask
from scene.readers.info import CameraInfo
from scene.readers.photos import camera_info, undistort

WIDTH, HEIGHT, FOCAL = 200, 150, 150.0


def _lens(model: str, focal: float = FOCAL) -> Lens:
    return make_lens(model, focal, WIDTH, HEIGHT)


def _view(path: Path, lens: Lens, mask: Mask | None = None, ignore_alpha: bool = False) -> CameraInfo:
    """A view of a photo that is to be undistorted."""
    view = camera_info(0, path.name, path, lens, np.eye(3), np.zeros(3), mask, ignore_alpha)
    return replace(view, file_size=picture_size(path))


def _dot(at: np.ndarray, width: int, height: int) -> np.ndarray:
    """A photo of a white spot, sigma 2 pixels, with its middle at a position in pixels (centres at .5)."""
    rows, columns = np.mgrid[:height, :width] + 0.5
    return np.exp(-((columns - at[0]) ** 2 + (rows - at[1]) ** 2) / 8)


def _middle(picture: np.ndarray, near: np.ndarray) -> np.ndarray:
    rows, columns = np.mgrid[: picture.shape[0], : picture.shape[1]] + 0.5
    weight = picture * ((columns - near[0]) ** 2 + (rows - near[1]) ** 2 < 15**2)
    return np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()


def test_the_table_has_every_model():
    assert {*DISTORTIONS, "EQUIRECTANGULAR", "INVALID"} == set(pycolmap.CameraModelId.__members__)


@pytest.mark.parametrize("model", DISTORTED)
def test_things_are_where_the_pinhole_sees_them(tmp_path, model):
    lens = _lens(model)
    assert pinhole_of(lens, "a.png") is None
    plan = undistortion(lens, WIDTH, HEIGHT)
    fx, fy, cx, cy, width, height = plan.pinhole
    for index, (u, v) in enumerate([(0.5, 0.5), (0.2, 0.25), (0.8, 0.75), (0.85, 0.2)]):
        place = np.array([u * width, v * height])
        ray = np.array([(place[0] - cx) / fx, (place[1] - cy) / fy, 1.0])
        picture = _dot(colmap_camera(lens).img_from_cam(ray), WIDTH, HEIGHT)
        path = tmp_path / f"{index}.png"
        Image.fromarray(np.uint8(255 * picture.round(3))).convert("RGB").save(path)
        (result,) = undistort([_view(path, lens)])
        with Image.open(result.image_path) as image:
            assert image.size == (width, height)
            seen = np.asarray(image, dtype=np.float64)[..., 0]
        # A round spot becomes an oval, whose middle is off by the distortion's second derivative: 0.1 pixels here.
        assert np.abs(_middle(seen, place) - place).max() < 0.15
        # Without undistortion the spot would be elsewhere, except in the middle of the photo.
        assert (
            index == 0
            or np.abs(_middle(picture, place) - place).max() > 1
            or picture[tuple(place.astype(int)[::-1])] < 0.5
        )
    assert result.mask is None  # as COLMAP chooses it, every pixel lies in the photo


@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", "PINHOLE", "OPENCV", "FULL_OPENCV", "FOV"])
def test_lenses_without_distortion_are_pinholes(model):
    lens = _lens(model)
    zeros = (0.0,) * len(DISTORTIONS[model])
    lens = lens._replace(params=lens.params[: len(lens.params) - len(zeros)] + zeros)
    assert pinhole_of(lens, "a.png") == (FOCAL, FOCAL, 104.0, 72.0, WIDTH, HEIGHT)


@pytest.mark.parametrize("model", ["SIMPLE_FISHEYE", "OPENCV_FISHEYE", "FOV", "EUCM", "RADIAL"])
def test_lenses_too_wide_for_a_pinhole_show_their_middle(model):
    """Their border is in no pinhole image, and COLMAP's choice of size would be arbitrary (40 x 30 pixels)."""
    lens = _lens(model, focal=50.0)
    if model == "RADIAL":  # its polynomial decreases again far out
        lens = lens._replace(params=(*lens.params[:-2], 0.05, -0.02))
    plan = undistortion(lens, WIDTH, HEIGHT)
    shown = visible_pixels(lens, WIDTH, HEIGHT)
    assert plan.widest == pytest.approx(WIDEST)
    assert plan.pinhole.width / 2 / plan.pinhole.fx == pytest.approx(np.tan(np.radians(WIDEST)), rel=0.02)
    rays = colmap_camera(lens)  # the reference: pixels that count project back to where they were
    x, y = np.meshgrid(np.arange(plan.pinhole.width) + 0.5, np.arange(plan.pinhole.height) + 0.5)
    local = np.stack([(x - plan.pinhole.cx) / plan.pinhole.fx, (y - plan.pinhole.cy) / plan.pinhole.fy], -1)
    for row, column in np.random.default_rng(0).integers(0, local.shape[:2], (200, 2)):
        pixel = rays.img_from_cam(np.append(local[row, column], 1.0))
        back = rays.cam_from_img(pixel) if pixel is not None else None
        once = back is not None and np.linalg.norm(back - local[row, column]) * plan.pinhole.fx < 0.5
        inside = pixel is not None and (pixel > 1).all() and (pixel < (WIDTH - 1, HEIGHT - 1)).all()
        counts = shown[row, column]
        assert counts <= once
        assert counts or not (once and inside)
    if model == "RADIAL":
        assert 0.3 < shown.mean() < 1


def _photo(path, color=(200, 100, 50), size=(WIDTH, HEIGHT), mode="RGB"):
    pixels = np.random.default_rng(1).integers(0, 256, (size[1], size[0], 4), dtype=np.uint8)
    pixels[..., :3] = np.asarray(color) + pixels[..., :3] // 8
    Image.fromarray(pixels).convert(mode).save(path)
    return path


def test_the_cache_is_keyed_by_content(tmp_path, cache_folder, capsys):
    lens = _lens("OPENCV")
    path = _photo(tmp_path / "a.png")
    photo = _view(path, lens)
    (first,) = undistort([photo])
    said = capsys.readouterr().err
    assert f"are kept in {cache_folder / 'undistorted'}" in said and "GS_CACHE" in said
    assert first.image_path.is_relative_to(cache_folder) and sorted(p.name for p in tmp_path.iterdir()) == ["a.png"]
    before = folder_state(cache_folder)

    copy = tmp_path / "b.png"
    copy.write_bytes(path.read_bytes())
    again, other = undistort([photo, replace(photo, image_path=copy)])
    assert again.image_path == other.image_path == first.image_path
    assert folder_state(cache_folder) == before and "are kept" not in capsys.readouterr().err

    first.image_path.write_bytes(first.image_path.read_bytes()[:-30])  # as after a full disk
    undistort([photo])
    assert first.image_path.read_bytes() == before[str(first.image_path.relative_to(cache_folder))][1]

    others = [
        replace(photo, lens=lens._replace(params=(*lens.params[:-1], 0.001))),
        replace(photo, mask=Mask(_photo(tmp_path / "m.png", mode="L"))),
        replace(photo, mask=Mask(tmp_path / "m.png", inverted=True)),
    ]
    _photo(path, color=(10, 20, 30))
    assert len({result.image_path for result in undistort([photo, *others])} | {first.image_path}) == 5


def test_pictures_smaller_than_their_lens(tmp_path):
    whole = undistortion(_lens("OPENCV_FISHEYE"), WIDTH, HEIGHT).pinhole
    # Sizes are whole pixels.
    half = undistort([_view(_photo(tmp_path / "a.png", size=(100, 75)), _lens("OPENCV_FISHEYE"))])[0]
    np.testing.assert_allclose((half.fx, half.fy, half.cx, half.cy), np.array(whole[:4]) / 2, atol=0.5)
    assert abs(half.width - whole.width / 2) <= 1


def _masked(tmp_path, meaning: str):
    grey = np.full((HEIGHT, WIDTH), 255, np.uint8)
    grey[:, : WIDTH // 2] = 0
    Image.fromarray(grey).save(tmp_path / "mask.png")
    mask = Mask(tmp_path / "mask.png", meaning=meaning)
    (result,) = undistort([_view(_photo(tmp_path / "a.png"), _lens("OPENCV"), mask)])
    with Image.open(result.image_path) as image:
        return result, np.asarray(image)


def test_a_mask_is_undistorted_with_its_picture(tmp_path):
    result, pixels = _masked(tmp_path, "ignore")
    assert pixels.shape[2] == 3
    counts = result.mask.decode((result.width, result.height))[0].numpy()
    camera = colmap_camera(_lens("OPENCV"))
    rows, columns = np.nonzero(counts == 255)
    x = [(columns + 0.5 - result.cx) / result.fx, (rows + 0.5 - result.cy) / result.fy]
    seen = camera.img_from_cam(np.column_stack([*x, np.ones(len(rows))]))
    assert seen[:, 0].min() >= WIDTH / 2  # masked pixels do not mix into pixels that count
    assert len(rows) == pytest.approx(0.5 * counts.size, rel=0.1)


def test_a_mask_that_is_gone_from_the_cache_is_made_anew(tmp_path, cache_folder):
    result, _ = _masked(tmp_path, "ignore")
    before = result.mask.path.read_bytes()
    for damage in (b"", before[: len(before) // 2], None):
        result.mask.path.unlink() if damage is None else result.mask.path.write_bytes(damage)
        again, _ = _masked(tmp_path, "ignore")
        assert again.mask.path.read_bytes() == before
    kept = folder_state(cache_folder)
    _masked(tmp_path, "ignore")
    assert folder_state(cache_folder) == kept


def test_a_transparent_mask_becomes_alpha(tmp_path):
    result, pixels = _masked(tmp_path, TRANSPARENT)
    assert result.mask is None and pixels.shape[2] == 4
    assert (pixels[:, :60, 3] == 0).all() and (pixels[:, -60:, 3] == 255).all()
    # Colours stay straight up to the edge: masked pixels do not bleed in. The noise is 240 / 8 levels over the base.
    shown = pixels[pixels[..., 3] > 128][:, 0]
    assert shown.min() >= 199 and shown.max() <= 232


def test_alpha_is_undistorted_or_ignored(tmp_path):
    pixels = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    pixels[:, WIDTH // 2 :] = (200, 100, 50, 255)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    photo = _view(tmp_path / "a.png", _lens("OPENCV"))
    kept, ignored = undistort([photo, replace(photo, ignore_alpha=True)])
    with Image.open(kept.image_path) as image:
        alpha = np.asarray(image)[..., 3]
        assert np.asarray(image)[alpha > 0][:, 0].min() >= 198  # not darkened by the hidden black
    with Image.open(ignored.image_path) as image:
        assert image.mode == "RGB"
    counts = ignored.mask.decode((ignored.width, ignored.height))[0].numpy()
    assert kept.mask is None and ((counts == 255) <= (alpha == 255)).all() and (counts == 255).any()


def test_a_real_distorted_scene(shared_dir):
    info = read(shared_dir / "scenes" / "fox_raw")
    assert len(info.train_cameras) == 12 and len(info.point_cloud.points) == 5115
    for camera in info.train_cameras:
        assert camera.mask is None and camera.file_size == (camera.width, camera.height)
        # COLMAP keeps focal lengths; this lens has almost no distortion, so sizes stay similar too.
        with Image.open(shared_dir / "scenes" / "fox_raw" / "images" / camera.image_name) as image:
            assert abs(image.width - camera.width) < 0.05 * image.width


def test_a_wide_lens_in_a_scene(tmp_path, capsys):
    """Pixels that the photo does not show do not count."""
    folder = tmp_path / "scene"
    make_colmap_scene(folder, model="RADIAL", params=(25.0, 45.0, 34.5, 0.05, -0.02), views=2)
    for camera in read(folder).train_cameras:
        assert camera.mask is not None
    assert "2 photos, the first is v" in capsys.readouterr().err
    for view in Scene(options_of(folder, tmp_path / "out"), FakeGaussians()).getTrainCameras():
        assert view.counted_pixels.shape == (1, view.image_height, view.image_width)
        assert 0.3 < view.counted_pixels.float().mean() < 1
