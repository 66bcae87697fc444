"""Colour profiles of photos: what trains, and what convert.py writes, is sRGB as colour formulas have it."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from icc import cmyk_profile, grey_profile, rgb_profile, to_srgb
from PIL import Image

from scene.images.decode import decode
from scene.images.masks import Mask
from splatting.files import color_profiles
from splatting.sfm import worker
from splatting.sfm.images import check_images, prepare_images
from splatting.sfm.layout import Layout, image_names

COLORS = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
GREY = COLORS[..., 0]
WIDE = ["Display P3", "Adobe RGB", "ProPhoto"]


@pytest.fixture(autouse=True)
def _nothing_said(monkeypatch):
    monkeypatch.setattr(color_profiles, "_SAID", set())


def _decoded(path: Path, image: Image.Image, profile: bytes) -> np.ndarray:
    image.save(path, icc_profile=profile)
    return decode(path, image.size).permute(1, 2, 0).numpy()


@pytest.mark.parametrize("ending", ["png", "tif", "webp"])
@pytest.mark.parametrize("name", WIDE)
def test_photos_become_srgb_with_one_line(tmp_path, capsys, name, ending):
    for number in range(2):
        path = tmp_path / f"{number}.{ending}"
        exact = {"lossless": True} if ending == "webp" else {}
        Image.fromarray(COLORS).save(path, icc_profile=rgb_profile(name), **exact)
        found = decode(path, (64, 48)).permute(1, 2, 0).numpy()
        assert np.abs(found - 255 * to_srgb(COLORS / 255, name)).max() < 1.5
    first = tmp_path / f"0.{ending}"
    said = f"photos with the colour profile {name} are converted to sRGB; the first is {first}\n"
    assert capsys.readouterr().err == said


@pytest.mark.parametrize("profile", [rgb_profile("sRGB"), b"no profile", cmyk_profile(), grey_profile(1.8)])
def test_other_profiles_leave_the_bytes(tmp_path, capsys, profile):
    """sRGB's, broken ones, and ones of another kind of photo, of which a line is said."""
    assert np.array_equal(_decoded(tmp_path / "a.png", Image.fromarray(COLORS), profile), COLORS)
    srgb = profile == rgb_profile("sRGB")
    assert capsys.readouterr().err.startswith("" if srgb else "warning: colour profiles are ignored that cannot be")


def test_grey_and_cmyk_have_profiles_of_their_own(tmp_path):
    encoded = _encoded((GREY[..., None] / 255) ** 1.8)
    deep = Image.fromarray(GREY.astype(np.uint16) * 257)
    for file, image in (("l.png", Image.fromarray(GREY)), ("deep.png", deep), ("deep.tif", deep)):
        assert np.abs(_decoded(tmp_path / file, image, grey_profile(1.8)) - 255 * encoded).max() < 1.5, file
    for file, image in (("l.png", Image.fromarray(GREY)), ("deep.png", deep)):
        expected = 255 * to_srgb(np.repeat(GREY[..., None] / 255, 3, axis=2), "ProPhoto")
        assert np.abs(_decoded(tmp_path / file, image, rgb_profile("ProPhoto")) - expected).max() < 1.5
    ink = Image.merge("CMYK", [Image.new("L", (64, 48))] * 3 + [Image.fromarray(GREY)])
    found = _decoded(tmp_path / "c.tif", ink, cmyk_profile()).astype(float)
    lightness = 100 * (1 - GREY / 255.0)
    luminance = np.where(lightness > 8, ((lightness + 16) / 116) ** 3, lightness / 903.3)
    assert np.abs(found - 255 * _encoded(luminance)[..., None]).max() < 3


def _encoded(linear: np.ndarray) -> np.ndarray:
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def test_alpha_stays_and_masks_are_no_colours(tmp_path):
    image = Image.fromarray(np.dstack([COLORS, GREY]))
    found = _decoded(tmp_path / "a.png", image, rgb_profile("ProPhoto"))
    assert np.array_equal(found[..., 3], GREY)
    assert np.abs(found[..., :3] - 255 * to_srgb(COLORS / 255, "ProPhoto")).max() < 1.5
    half = Image.fromarray(np.where(GREY > 99, 150, 0).astype(np.uint8))
    half.save(tmp_path / "mask.png", icc_profile=grey_profile(0.5))  # which would make 150 white, or darker
    assert np.array_equal(Mask(tmp_path / "mask.png").decode((64, 48))[0].numpy() == 255, GREY > 99)


@pytest.mark.parametrize("orientation", [1, 6])
@pytest.mark.parametrize(("name", "kept"), [("sRGB", True), ("Display P3", False)])
def test_photos_for_colmap_are_srgb_and_others_are_linked(tmp_path, capsys, name, kept, orientation):
    layout, exif = Layout(tmp_path), Image.Exif()
    layout.input.mkdir()
    exif[0x0112] = orientation
    Image.fromarray(COLORS).save(layout.input / "a.png", icc_profile=rgb_profile(name), exif=exif)
    check_images(layout, ["a.png"], None)
    assert ("converted to sRGB" in capsys.readouterr().err) != kept  # before anything is made
    prepare_images(layout, ["a.png"], None)
    assert image_names(layout.prepared) == ["a.png"]
    assert (layout.prepared / "a.png").samefile(layout.input / "a.png") == (kept and orientation == 1)
    with Image.open(layout.prepared / "a.png") as image:
        assert not color_profiles.has_other_colors(image)
        upright = COLORS if orientation == 1 else np.rot90(COLORS, -1)
        assert np.abs(np.asarray(image) - 255 * to_srgb(upright / 255, name)).max() < 1.5


def test_photos_that_colmap_undistorts_where_they_lie_keep_their_profile(colmap_scene, tmp_path):
    """As by --skip_matching, which prepares no photos. What is written is read right."""
    photos = [path for path in (colmap_scene / "images").rglob("*") if path.is_file()]
    for path in photos:
        with Image.open(path) as image:
            image.convert("RGB").save(path, icc_profile=rgb_profile("ProPhoto"))
    job = {"model": str(colmap_scene / "sparse" / "0"), "images": str(colmap_scene / "images"), "jpeg_quality": 95}
    for native in (False, True):
        out = tmp_path / str(native) / "out"
        out.mkdir(parents=True)
        worker.undistort(job | {"out": str(out), "capture": str(tmp_path / "capture.json"), "native": native})
        for path in photos:
            size = Image.open(path).size
            written = out / "images" / path.relative_to(colmap_scene / "images")
            assert (decode(written, size).int() - decode(path, size).int()).abs().float().mean() < 2, native
    assert pycolmap.Reconstruction(str(out / "sparse")).num_reg_images() == len(photos)
