"""Photos to images: sizes, modes, resizing against Pillow, broken files, and colour profiles as formulas have them."""

import io
import struct
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from icc import cmyk_profile, grey_profile, rgb_profile, to_srgb
from PIL import Image, PngImagePlugin

from applications.convert import worker
from applications.convert.images import check_images, prepare_images
from applications.convert.layout import Layout, image_names
from groundwork.files import color_profiles
from scene.images.decode import decode, picture_size
from scene.images.masks import Mask
from scene.images.sizes import training_size
from utils.system_utils import UserError


@pytest.mark.parametrize(
    ("file", "r", "scale", "size"),
    [
        ((1601, 901), 1, 1, (1601, 901)),
        ((1601, 901), 2, 1, (800, 450)),  # 800.5 and 450.5 round to even
        ((1601, 901), 8, 1, (200, 113)),
        ((1602, 901), -1, 1, (1600, 899)),  # 899.9 is cut off
        ((1601, 901), -1, 1, (1599, 900)),  # the reference's division: 1601 / (1601 / 1600) is just below 1600
        ((900, 4000), -1, 1, (900, 4000)),  # only the width counts
        ((1601, 901), 1000, 1, (1000, 562)),  # 562.8 is cut off
        ((500, 333), 1000, 1, (1000, 666)),  # a width can enlarge
        ((3, 3), 8, 1, (1, 1)),  # never without pixels
        ((1000, 500), 400, 2.0, (200, 100)),
    ],
)
def test_training_size(file, r, scale, size):
    assert training_size(*file, r, scale) == size


@pytest.mark.parametrize(
    ("photo", "r", "said"),
    [
        ((48, 32), 16385, r"-r\) 16385 is too wide; give at most 16384"),
        ((48, 32), 10**400, r"-r\) 10+ is too wide; give at most 16384"),
        ((10, 30), 8192, r"10 x 30 pixels would train at 8192 x 24576 with --resolution \(-r\) 8192"),
        ((100, 20_000), -1, "would train at 100 x 20000"),
    ],
    ids=lambda value: str(value)[:30],
)
def test_absurd_sizes_are_refused(photo, r, said):
    with pytest.raises(UserError, match=said):
        training_size(*photo, r)


def _noise(shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def _chw(image: Image.Image) -> torch.Tensor:
    return torch.from_numpy(np.array(image)).permute(2, 0, 1)


def test_resizing_is_pillows_bicubic(tmp_path):
    image = Image.fromarray(_noise((31, 47, 3)))
    image.save(tmp_path / "a.png")
    assert torch.equal(decode(tmp_path / "a.png", (47, 31)), _chw(image))
    assert torch.equal(decode(tmp_path / "a.png", (20, 13)), _chw(image.resize((20, 13))))


def test_alpha_is_copied_at_full_size_and_weighs_colours_when_shrunk(tmp_path):
    pixels = _noise((32, 32, 4))
    pixels[:16, :, :3] = 255  # white behind zero alpha must not bleed into the neighbours
    pixels[:16, :, 3] = 0
    pixels[16:, :, :3] = 40
    pixels[16:, :, 3] = 255
    Image.fromarray(pixels).save(tmp_path / "a.png")
    assert torch.equal(decode(tmp_path / "a.png", (32, 32)), _chw(Image.fromarray(pixels)))
    small = decode(tmp_path / "a.png", (8, 8)).float()
    premultiplied = torch.from_numpy(pixels[..., :3] * (pixels[..., 3:] / 255.0)).permute(2, 0, 1)
    separate = Image.Resampling.BICUBIC
    wanted = np.stack(
        [np.array(Image.fromarray(c.astype(np.float32)).resize((8, 8), separate)) for c in premultiplied.numpy()]
    )
    alpha = np.array(Image.fromarray(pixels[..., 3].astype(np.float32)).resize((8, 8), separate)).clip(0, 255)
    seen = alpha > 20  # colours of nearly transparent pixels are rounded coarsely
    difference = np.abs(small[:3].numpy() - wanted / np.maximum(alpha, 1) * 255)[:, seen]
    assert seen.any() and difference.max() <= 255 / 20  # half a step of the premultiplied colour, divided by alpha
    assert np.abs(small[3].numpy() - alpha).max() <= 1


def test_grey_palette_cmyk_and_16_bit_become_rgb(tmp_path):
    grey = _noise((6, 5))
    Image.fromarray(grey).save(tmp_path / "l.png")
    Image.fromarray(grey.astype(np.uint16) * 257).save(tmp_path / "deep.png")
    for name in ("l.png", "deep.png"):
        assert torch.equal(decode(tmp_path / name, (5, 6)), torch.from_numpy(grey).expand(3, 6, 5)), name

    rgb = Image.fromarray(_noise((6, 5, 3)))
    palette = rgb.quantize(16)
    palette.save(tmp_path / "p.png")
    assert torch.equal(decode(tmp_path / "p.png", (5, 6)), _chw(palette.convert("RGB")))
    palette.save(tmp_path / "clear.png", transparency=0)
    assert decode(tmp_path / "clear.png", (5, 6)).shape == (4, 6, 5)
    rgb.convert("CMYK").save(tmp_path / "c.tif")
    assert torch.equal(decode(tmp_path / "c.tif", (5, 6)), _chw(rgb.convert("CMYK").convert("RGB")))
    Image.fromarray(np.dstack([grey, grey])).save(tmp_path / "la.png")
    assert torch.equal(decode(tmp_path / "la.png", (5, 6))[3], torch.from_numpy(grey))


@pytest.mark.parametrize("suffix", ["png", "jpg"])
@pytest.mark.parametrize("kept", [0.0, 0.3, 0.9])
def test_a_truncated_picture_is_found_before_it_is_needed(tmp_path, suffix, kept):
    buffer = io.BytesIO()
    Image.fromarray(_noise((64, 64, 3))).save(buffer, "PNG" if suffix == "png" else "JPEG")
    whole = buffer.getvalue()
    path = tmp_path / f"cut.{suffix}"
    path.write_bytes(whole)
    assert picture_size(path) == (64, 64)
    path.write_bytes(whole[: int(len(whole) * kept)])
    for use in (picture_size, lambda path: decode(path, (64, 64))):
        with pytest.raises(UserError, match=f"cut.{suffix}"):
            use(path)


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


def _exif(space: int, index: str, orientation: int = 1) -> Image.Exif:
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif.get_ifd(0x8769).update({0xA001: space, 0xA005: {1: index}})
    return exif


def _png(*chunks: tuple[bytes, bytes]) -> PngImagePlugin.PngInfo:
    info = PngImagePlugin.PngInfo()
    for name, data in chunks:
        info.add(name, data)
    return info


def _chromaticities(*places: float) -> tuple[bytes, bytes]:
    return b"cHRM", struct.pack(">8I", *(round(1e5 * place) for place in places))


P3 = 0.3127, 0.3290, 0.680, 0.320, 0.265, 0.690, 0.150, 0.060
ADOBE = 0.3127, 0.3290, 0.64, 0.33, 0.21, 0.71, 0.15, 0.06
SRGB = 0.3127, 0.3290, 0.64, 0.33, 0.30, 0.60, 0.15, 0.06


@pytest.mark.parametrize(
    ("suffix", "options", "name"),
    [
        ("webp", {"exif": _exif(65535, "R03"), "lossless": True}, "Adobe RGB"),
        ("png", {"exif": _exif(2, "")}, "Adobe RGB"),
        ("png", {"exif": _exif(1, "R98")}, "sRGB"),
        ("png", {"exif": _exif(65535, "R98")}, "sRGB"),
        ("png", {"exif": _exif(65535, "R03"), "icc_profile": rgb_profile("ProPhoto")}, "ProPhoto"),
        ("png", {"pnginfo": _png((b"cICP", bytes([12, 13, 0, 1])))}, "Display P3"),
        ("png", {"pnginfo": _png((b"cICP", bytes([1, 13, 0, 1])), _chromaticities(*P3))}, "sRGB"),
        ("png", {"pnginfo": _png(_chromaticities(*P3))}, "Display P3"),
        ("png", {"pnginfo": _png((b"gAMA", struct.pack(">I", 45470)), _chromaticities(*ADOBE))}, "Adobe RGB"),
        ("png", {"pnginfo": _png((b"gAMA", struct.pack(">I", 45455)))}, "sRGB"),
        ("png", {"pnginfo": _png((b"gAMA", struct.pack(">I", 45455)), _chromaticities(*SRGB))}, "sRGB"),
        ("png", {"pnginfo": _png((b"sRGB", b"\0"), (b"gAMA", struct.pack(">I", 100000)))}, "sRGB"),
        ("png", {"pnginfo": _png((b"gAMA", struct.pack(">I", 0)), _chromaticities(*[0.0] * 8))}, "sRGB"),
    ],
)
def test_colours_that_other_data_tell_are_followed(tmp_path, suffix, options, name):
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(COLORS).save(path, **options)
    found = decode(path, (64, 48)).permute(1, 2, 0).numpy()
    if name == "sRGB":
        assert np.array_equal(found, COLORS)
    assert np.abs(found - 255 * to_srgb(COLORS / 255, name)).max() < 1.5


@pytest.mark.parametrize("kind", ["HEIF", "AVIF"])
def test_code_points_of_heic_and_avif_are_followed(tmp_path, capsys, kind):
    """Colours of a P3 picture are converted; PQ gets a line, as it cannot be shown in sRGB."""
    pillow_heif = pytest.importorskip("pillow_heif")
    pillow_heif.register_heif_opener()
    smooth = np.stack([*np.meshgrid(np.arange(60, 252, 3), np.arange(60, 204, 3)), np.full((48, 64), 90)], -1)
    image = Image.fromarray(smooth.astype(np.uint8))
    for primaries, curve in ((12, 13), (9, 16)):
        path = tmp_path / f"{curve}.{kind.lower()}"
        nclx = {"color_primaries": primaries, "transfer_characteristics": curve, "matrix_coefficients": 1}
        image.info["nclx_profile"] = nclx | {"full_range_flag": 1}
        if kind == "HEIF":
            image.save(path, kind, save_nclx_profile=True, quality=100, chroma=444)
        else:
            image.save(path, kind, quality=100, subsampling="4:4:4")
            data = path.read_bytes()
            place = data.index(b"colrnclx") + 8
            path.write_bytes(data[:place] + struct.pack(">2H", primaries, curve) + data[place + 4 :])
        found = decode(path, (64, 48)).permute(1, 2, 0).numpy()
        expected = to_srgb(smooth / 255, "Display P3" if curve == 13 else "sRGB")
        assert np.abs(found - 255 * expected).mean() < 2
    said = capsys.readouterr().err
    assert "colour profile Display P3 are converted to sRGB" in said
    assert (
        "warning: photos are taken as sRGB, though their colours are of primaries BT.2020 and transfer curve PQ" in said
    )


def test_there_is_one_limit_of_pixels(tmp_path):
    Image.new("1", (20_000, 10_000)).save(tmp_path / "a.png")
    assert picture_size(tmp_path / "a.png") == (20_000, 10_000)
    Image.new("1", (20_000, 14_000)).save(tmp_path / "b.png")
    with pytest.raises(UserError, match="b.png has more than 268,435,456 pixels; make it smaller"):
        picture_size(tmp_path / "b.png")


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
    """Photos are not prepared, as with --skip_matching. The written files are read with the right colours."""
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


def test_an_alpha_that_hides_nothing_is_dropped(tmp_path):
    pixels = _noise((8, 8, 4))
    pixels[..., 3] = 255
    Image.fromarray(pixels).save(tmp_path / "a.png")
    assert decode(tmp_path / "a.png", (8, 8)).shape == (3, 8, 8)


def test_exif_orientation_is_ignored(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    image = Image.fromarray(_noise((10, 20, 3)))
    image.save(tmp_path / "a.png", exif=exif)
    assert picture_size(tmp_path / "a.png") == (20, 10)
    assert torch.equal(decode(tmp_path / "a.png", (20, 10)), _chw(image))
