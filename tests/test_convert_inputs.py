"""Files that convert.py finds in `input`: photos of every format by their content, and what is not used, by name."""

import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from photo_room import SIZE, make_photos
from PIL import Image, ImageOps

import convert
from scene.images.decode import picture_size
from splatting.sfm.images import prepare_images
from splatting.sfm.inputs import sort_inputs
from splatting.sfm.layout import Layout, image_names
from utils.system_utils import UserError

# Names of files, the formats that Pillow writes for them, and their names for COLMAP.
FORMATS = [
    *[("a.jfif", "JPEG", "a.jfif.jpg"), ("b.jpe", "JPEG", "b.jpe.jpg"), ("c", "JPEG", "c.jpg"), ("d", "PNG", "d.png")],
    *[("e.jp2", "JPEG2000", "e.jp2.png"), ("f.tga", "TGA", "f.tga.png"), ("g.AVIF", "AVIF", "g.AVIF.jpg")],
    *[("h.HEIC", "HEIF", "h.HEIC.jpg"), ("i.hif", "HEIF", "i.hif.jpg"), ("j.jpg", "HEIF", "j.jpg")],
    *[
        ("k.png", "JPEG", "k.png"),
        ("l.ppm", "PPM", "l.ppm.png"),
        ("m", "TIFF", "m.tif"),
        ("n.webp", "WEBP", "n.webp.png"),
    ],
]
FOCAL_MM, FOCAL_35 = 4.25, 26


@pytest.fixture
def heif():
    """Pillow with a reader and a writer of HEIC."""
    module = pytest.importorskip("pillow_heif", reason="no pillow-heif: pip install '.[heic]'")
    module.register_heif_opener()
    return module


def _exif(orientation: int) -> bytes:
    exif = Image.Exif()
    exif[0x010F], exif[0x0110], exif[0x0112] = "Maker", "Phone", orientation
    exif.get_ifd(0x8769).update({0x920A: FOCAL_MM, 0xA405: FOCAL_35})
    return exif.tobytes()  # from bytes alone, the writer of HEIC turns the picture, too, as phones do


def _picture() -> Image.Image:
    noise = np.random.default_rng(0).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    return Image.fromarray(noise).resize((96, 64), Image.Resampling.BICUBIC)


def _save(path: Path, file_format: str, **options: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    quality = {} if file_format in ("TIFF", "TGA", "PPM") else {"quality": 95}
    _picture().save(path, file_format, **quality, **options)


def test_photos_of_every_format_reach_colmap(tmp_path, heif):
    layout = Layout(tmp_path)
    for name, file_format, _ in FORMATS:
        _save(layout.input / name, file_format)
    found = sort_inputs(layout.input)
    assert (found.photos, found.unused) == ([name for name, *_ in FORMATS], {})
    prepare_images(layout, found.photos, None)
    assert image_names(layout.prepared) == [name for *_, name in FORMATS]
    expected = np.asarray(_picture(), dtype=float)
    for *_, name in FORMATS:
        read = pycolmap.Bitmap.read(str(layout.prepared / name), True).to_array()
        # Two compressions of quality 95, with chroma at half the size, change some levels; a wrong picture, over 40.
        assert np.abs(read - expected).mean() < 6, name


@pytest.mark.parametrize("orientation", [1, 6])
@pytest.mark.parametrize(("name", "file_format"), [("a.heic", "HEIF"), ("a.avif", "AVIF"), ("a", "JPEG")])
def test_exif_is_kept_and_the_orientation_applied_once(tmp_path, heif, name, file_format, orientation):
    layout = Layout(tmp_path)
    _save(layout.input / name, file_format, exif=_exif(orientation))
    prepare_images(layout, [name], None)
    (written,) = layout.prepared.iterdir()
    with Image.open(written) as image:
        exif = image.getexif()
        assert (exif[0x010F], exif[0x0110], exif.get(0x0112, 1)) == ("Maker", "Phone", 1)
        assert dict(exif.get_ifd(0x8769)) == {0x920A: FOCAL_MM, 0xA405: FOCAL_35}
        turned = _picture()
        turned.getexif()[0x0112] = orientation
        upright = np.asarray(ImageOps.exif_transpose(turned), dtype=float)
        assert np.abs(np.asarray(image, dtype=float) - upright).mean() < 6
    # What COLMAP makes of it: the focal length in pixels of a 35 mm film.
    focal = pycolmap.Bitmap.read(str(written), True).exif_focal_length()
    assert focal == pytest.approx(FOCAL_35 / np.hypot(36, 24) * np.hypot(96, 64), rel=0.1)


def test_names_that_meet_stay_apart(tmp_path):
    layout = Layout(tmp_path)
    for name in ("a", "a.jpg", "a.jpg.png"):
        _save(layout.input / name, "JPEG")
    prepare_images(layout, sort_inputs(layout.input).photos, None)
    assert image_names(layout.prepared) == ["a.jpg", "a.jpg.jpg", "a.jpg.png"]


def _fill(folder: Path) -> None:
    for name in ("1.jpg", "2.jpg", "3.jpg"):
        _save(folder / name, "JPEG")
    _save(folder / "sub" / "banner.gif", "GIF")
    _save(folder / "3.avif", "AVIF")
    (folder / "1.mov").write_bytes(b"\x00\x00\x00\x14ftypqt  \x00\x00\x00\x00qt  ")
    (folder / "clip").write_bytes(b"\x1a\x45\xdf\xa3" + bytes(40))
    (folder / "1.AAE").write_text("<plist/>")
    (folder / "notes").write_bytes(bytes([0, 0, 2, *[0] * 9, 8, 0, 8, 0, 24, 0]) + bytes(300))  # the header of a TGA
    (folder / "2.CR2").write_bytes(b"II*\x00\x10\x00\x00\x00CR\x02\x00")
    (folder / ".hidden").touch()
    _save(folder / ".thumbnails" / "1.jpg", "JPEG")


def test_every_file_that_is_not_used_is_named(tmp_path):
    _fill(tmp_path)
    found = sort_inputs(tmp_path)
    assert found.photos == ["1.jpg", "2.jpg", "3.jpg"]
    video = "video: pass it as --video to take frames of it"
    assert found.unused == {
        **{"1.mov": video, "clip": video, "1.AAE": "no picture", "notes": "no picture"},
        **{"2.CR2": "same name as 2.jpg, which is used", "3.avif": "same name as 3.jpg, which is used"},
        "sub/banner.gif": "GIF, the format of animations",
    }
    assert sort_inputs(tmp_path, but=[tmp_path / "clip"]).unused.keys() == found.unused.keys() - {"clip"}


def test_photos_that_can_not_be_read_stop_unless_they_are_left_out(tmp_path, heif):
    _fill(tmp_path)
    (tmp_path / "4.NEF").write_bytes(b"MM\x00*")
    _save(tmp_path / "5.tif", "TIFF", tiffinfo={50706: b"\x01\x04\x00\x00"})  # DNGVersion
    _save(tmp_path / "6.heic", "HEIF")
    (tmp_path / "6.heic").write_bytes((tmp_path / "6.heic").read_bytes()[:-9])
    picture = _picture()
    picture.info["nclx_profile"] = {"color_primaries": 9, "transfer_characteristics": 16, "matrix_coefficients": 9}
    picture.info["nclx_profile"]["full_range_flag"] = 1
    picture.save(tmp_path / "7.hif", "HEIF", save_nclx_profile=True)
    said = r"^4 photos in .* cannot be read: 4.NEF, 5.tif \(RAW: export as JPEG or TIFF\); 6.heic \(damaged: copy it "
    said += r"again\); 7.hif \(HDR picture: export as SDR\); follow these hints, or pass --skip_unreadable"
    with pytest.raises(UserError, match=said):
        sort_inputs(tmp_path)
    (tmp_path / "8.jpg").write_bytes((tmp_path / "1.jpg").read_bytes()[:-60])
    (tmp_path / "9.png").write_bytes(b"<html>")
    found = sort_inputs(tmp_path, skip_unreadable=True)
    assert found.photos == ["1.jpg", "2.jpg", "3.jpg"]
    assert {"4.NEF", "5.tif", "6.heic", "7.hif", "8.jpg", "9.png"} < found.unused.keys()


@pytest.mark.parametrize("skip", [False, True])
def test_photos_of_a_kind_that_no_copying_repairs_get_the_true_reason(tmp_path, skip):
    _fill(tmp_path)
    Image.new("1", (50_000, 4_000)).save(tmp_path / "4.png")
    Image.new("1", (50_000, 4_000)).save(tmp_path / "5.jfif", "PNG")
    Image.new("F", (9, 9)).save(tmp_path / "6.tif")
    with pytest.raises(UserError, match=r"4.png has more than \d+,\d+,\d+ pixels; make it smaller"):  # of a training
        picture_size(tmp_path / "4.png")
    found = {"too large to be read: make it smaller": ["4.png", "5.jfif"]}
    found |= {"floating-point pixels: save it with 8 or 16 bits": ["6.tif"]}
    if skip:
        (tmp_path / "7.jpg").write_bytes(b"<html>")
        found |= {"a web page, likely from a wrong address: download it again": ["7.jpg"]}
        unused = sort_inputs(tmp_path, skip_unreadable=True).unused
        assert {reason: [name for name in unused if unused[name] == reason] for reason in found} == found
    else:
        listed = "; ".join(f"{', '.join(names)} ({reason})" for reason, names in found.items())
        with pytest.raises(UserError, match=f"^3 photos in .* cannot be read: {re.escape(listed)}; follow these hints"):
            sort_inputs(tmp_path)


def test_links_to_folders_are_not_passed_over(tmp_path):
    """Their photos are not looked for, which may be most of the capture."""
    _fill(tmp_path / "input")
    _save(tmp_path / "4.jpg", "JPEG")
    for name, target in (("day 2", tmp_path), ("5.jpg", tmp_path / "gone.jpg"), ("4.jpg", tmp_path / "4.jpg")):
        (tmp_path / "input" / name).symlink_to(target)
    said = r"^2 photos in .* cannot be read: 5.jpg, day 2 \(a link to a folder or to nothing: copy .* hints, or pass"
    with pytest.raises(UserError, match=said):
        sort_inputs(tmp_path / "input")
    found = sort_inputs(tmp_path / "input", skip_unreadable=True)
    assert found.photos == ["1.jpg", "2.jpg", "3.jpg", "4.jpg"] and found.unused["day 2"].startswith("a link to")


def test_without_the_reader_of_heic_the_message_has_the_line_that_installs_it(tmp_path, heif, monkeypatch):
    _fill(tmp_path)
    for name in ("1.heic", "6.heic"):
        _save(tmp_path / name, "HEIF")
    monkeypatch.delitem(Image.OPEN, "HEIF")
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(UserError, match=r"1 photos .*: 6.heic \(HEIC: .*pip install '\.\[heic\]'`, or export as JPEG"):
        sort_inputs(tmp_path)
    assert sort_inputs(tmp_path, skip_unreadable=True).photos == ["1.jpg", "2.jpg", "3.jpg"]


@pytest.mark.slow
def test_a_folder_of_all_kinds_is_converted(tmp_path, heif, capsys):
    make_photos(tmp_path / "plain", 6)
    formats = ["JPEG", "HEIF", "AVIF", "JPEG2000", "TGA", "JPEG"]
    names = ["a.jfif", "b.HEIC", "c.avif", "d.jp2", "e.tga", "f"]
    (tmp_path / "input").mkdir()
    for path, name, file_format in zip(sorted((tmp_path / "plain").iterdir()), names, formats, strict=True):
        with Image.open(path) as image:
            image.save(tmp_path / "input" / name, file_format, **({} if file_format == "TGA" else {"quality": 95}))
    shutil.rmtree(tmp_path / "plain")
    (tmp_path / "input" / "b.AAE").write_text("<plist/>")
    convert.main(["-s", str(tmp_path), "--no_gpu"])
    said = capsys.readouterr().out
    assert "6 of 6 photos placed" in said and "not used: b.AAE (no picture)" in said
    report = json.loads((tmp_path / "convert_report.json").read_text())
    assert report["unused"] == {"b.AAE": "no picture"}
    assert len(image_names(tmp_path / "images")) == 6
    assert all(abs(np.subtract(Image.open(tmp_path / "images" / name).size, SIZE)).max() < 12
               for name in image_names(tmp_path / "images"))  # fmt: skip
