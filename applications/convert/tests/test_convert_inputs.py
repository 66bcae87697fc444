"""Files that convert.py finds in `input`: photos of every format, what is not used, and photos that come later."""

import contextlib
import re
import shutil
import sqlite3
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from photo_room import camera_centers, make_photos
from PIL import Image, ImageOps, PngImagePlugin

import convert
from applications.convert import stages
from applications.convert.adding import keep_base
from applications.convert.images import find_panoramas, prepare_images
from applications.convert.inputs import sort_inputs
from applications.convert.layout import Layout, image_names
from scene.images.decode import picture_size
from utils.system_utils import UserError

# Names of files, the formats that Pillow writes for them, and their names for COLMAP: two that meet stay apart.
FORMATS = [
    *[("a.jfif", "JPEG", "a.jfif.jpg"), ("b.jpe", "JPEG", "b.jpe.jpg"), ("c", "JPEG", "c.jpg.jpg")],
    *[("c.jpg", "JPEG", "c.jpg"), ("d", "PNG", "d.png"), ("e.jp2", "JPEG2000", "e.jp2.png")],
    *[("f.tga", "TGA", "f.tga.png"), ("g.AVIF", "AVIF", "g.AVIF.jpg"), ("h.HEIC", "HEIF", "h.HEIC.jpg")],
    *[("i.hif", "HEIF", "i.hif.jpg"), ("j.jpg", "HEIF", "j.jpg"), ("k.png", "JPEG", "k.png")],
    *[("l.ppm", "PPM", "l.ppm.png"), ("m", "TIFF", "m.tif"), ("n.webp", "WEBP", "n.webp.png")],
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
    assert image_names(layout.prepared) == sorted(name for *_, name in FORMATS)
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
    (tmp_path / "day 2").symlink_to(tmp_path.parent)  # whose photos are not looked for
    Image.new("1", (50_000, 6_000)).save(tmp_path / "a.png")
    Image.new("1", (50_000, 6_000)).save(tmp_path / "b.jfif", "PNG")
    Image.new("F", (9, 9)).save(tmp_path / "c.tif")
    with pytest.raises(UserError, match=r"a.png has more than \d+,\d+,\d+ pixels; make it smaller"):  # of a training
        picture_size(tmp_path / "a.png")
    found = {"4.NEF": "RAW: ", "5.tif": "RAW: ", "6.heic": "damaged: ", "7.hif": "HDR picture: ", "a.png": "too large"}
    found |= {"b.jfif": "too large", "c.tif": "floating-point pixels: ", "day 2": "a link to a folder or to nothing: "}
    said = r"^8 photos in .* cannot be read: .*4.NEF, 5.tif \(RAW: .*; follow these hints, or pass --skip_unreadable"
    with pytest.raises(UserError, match=said):
        sort_inputs(tmp_path)
    (tmp_path / "8.jpg").write_bytes((tmp_path / "1.jpg").read_bytes()[:-60])
    (tmp_path / "9.png").write_bytes(b"<html>")
    found |= {"8.jpg": "", "9.png": "a web page"}
    taken = sort_inputs(tmp_path, skip_unreadable=True)
    assert taken.photos == ["1.jpg", "2.jpg", "3.jpg"]
    assert all(taken.unused[name].startswith(reason) for name, reason in found.items())


def test_without_the_reader_of_heic_the_message_has_the_line_that_installs_it(tmp_path, heif, monkeypatch):
    _fill(tmp_path)
    for name in ("1.heic", "6.heic"):
        _save(tmp_path / name, "HEIF")
    monkeypatch.delitem(Image.OPEN, "HEIF")
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(UserError, match=r"1 photo .*: 6.heic \(HEIC: .*pip install '\.\[heic\]'`, or export as JPEG"):
        sort_inputs(tmp_path)
    assert sort_inputs(tmp_path, skip_unreadable=True).photos == ["1.jpg", "2.jpg", "3.jpg"]


@pytest.mark.parametrize("end", ["jpg", "png", "tif", "webp"])
@pytest.mark.parametrize(
    ("size", "tags", "found"),
    [
        ((64, 32), 'GPano:ProjectionType="equirectangular"', (True, True)),
        ((64, 32), 'x="1"><GPano:ProjectionType>equirectangular</GPano:ProjectionType', (True, True)),
        ((64, 32), 'GPano:ProjectionType="cylindrical"', (True, False)),
        ((64, 31), 'GPano:ProjectionType="equirectangular"', (False, False)),
        (
            (64, 32),
            'GPano:ProjectionType="equirectangular" GPano:FullPanoWidthPixels="128" '
            'GPano:CroppedAreaImageWidthPixels="64"',
            (True, False),
        ),
    ],
)
def test_panoramas_are_known_by_xmp(tmp_path, end, size, tags, found):
    xmp = f"<x:xmpmeta xmlns:GPano='http://ns.google.com/photos/1.0/panorama/'><d {tags}></d></x:xmpmeta>".encode()
    options: dict = {"xmp": xmp}
    if end == "png":
        options = {"pnginfo": PngImagePlugin.PngInfo()}
        options["pnginfo"].add_itxt("XML:com.adobe.xmp", xmp.decode())
    if end == "tif":
        options = {"tiffinfo": {700: xmp}}
    Image.new("RGB", size).save(tmp_path / f"a.{end}", **options)
    assert tuple(map(bool, find_panoramas(tmp_path, [f"a.{end}"]))) == found


@pytest.mark.parametrize(("marked", "lens", "said"), [
    (3, "EQUIRECTANGULAR", "panoramas by their XMP data: taking --camera EQUIRECTANGULAR"),
    (2, "OPENCV", r"3 of 3 photos are twice as wide as high \(0.jpg, .*for panoramas .* --camera EQUIRECT"),
])  # fmt: skip
def test_the_lens_of_panoramas_is_taken_or_named(tmp_path, monkeypatch, capsys, marked, lens, said):
    (tmp_path / "input").mkdir()
    for number in range(3):
        xmp = {"xmp": b'GPano:ProjectionType="equirectangular"'} if number < marked else {}
        Image.new("RGB", (64, 32)).save(tmp_path / "input" / f"{number}.jpg", **xmp)
    taken: list[str] = []
    monkeypatch.setattr(convert, "Pycolmap", lambda layout, settings: taken.append(settings.camera) or next(iter(())))
    with pytest.raises(StopIteration):
        convert.main(["-s", str(tmp_path)])
    assert taken == [lens] and re.search(said, capsys.readouterr().out, re.MULTILINE)


PLACES = 8
LATER = ("photo_03.png", "photo_06.png")


def _scenes(folder: Path) -> None:
    """The photos of `all`, and a scene of those that are not LATER."""
    make_photos(folder / "all", PLACES)
    shutil.copytree(folder / "all", folder / "scene" / "input", ignore=shutil.ignore_patterns(*LATER))
    convert.main(["-s", str(folder / "scene"), "--no_gpu"])


@pytest.fixture
def room(once, tmp_path: Path) -> Path:
    """A copy, with `scene` and `all`."""
    return Path(shutil.copytree(once("room to add to", _scenes), tmp_path / "copy", copy_function=shutil.copy2))


def _run(scene: Path, *options: str) -> pycolmap.Reconstruction:
    convert.main(["-s", str(scene), "--no_gpu", *options])
    return pycolmap.Reconstruction(str(scene / "sparse" / "0"))


def _poses(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    return {image.name: image.cam_from_world().matrix() for image in model.images.values()}


def _put(room: Path, *names: str) -> None:
    for name in names:
        shutil.copy2(room / "all" / name, room / "scene" / "input")


@pytest.mark.slow
def test_old_photos_keep_poses_and_bytes_and_new_ones_are_placed(room, monkeypatch, capsys):
    """Also after an interruption, and beside a photo of another place."""
    scene = room / "scene"
    before = pycolmap.Reconstruction(str(scene / "sparse" / "0"))
    pictures = {path.name: path.read_bytes() for path in (scene / "images").iterdir()}
    _run(scene, "--orient")
    _put(room, *LATER[:1])
    _run(scene, "--add")
    assert (scene / "orientation.json").is_file()  # asked for once
    assert f"added: 1 of 1 new photos; the {PLACES - 2} before keep their poses" in capsys.readouterr().out
    _put(room, *LATER[1:])
    noise = np.random.default_rng(0).integers(0, 255, (180, 240, 3), dtype=np.uint8)
    Image.fromarray(noise).save(scene / "input" / "elsewhere.png")
    with monkeypatch.context() as patch:
        patch.setattr(stages.report, "read_survey", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            _run(scene, "--add")
    model = _run(scene, "--add")
    assert f"added: 1 of 2 new photos; the {PLACES - 1} before keep their poses" in capsys.readouterr().out
    old, new = _poses(before), _poses(model)
    assert sorted(new) == sorted([*old, *LATER])
    assert max(np.abs(new[name] - pose).max() for name, pose in old.items()) < 1e-12
    assert {path.name: path.read_bytes() for path in (scene / "images").iterdir() if path.name in old} == pictures
    assert len(model.cameras) == 1 and model.cameras[1].params.tolist() == before.cameras[1].params.tolist()
    at = camera_centers(PLACES)[[int(name[6:8]) for name in sorted(new)]]
    found = np.array([model.find_image_with_name(name).projection_center() for name in sorted(new)])
    fit = pycolmap.estimate_sim3d(found, at)
    assert np.linalg.norm(fit * found - at, axis=1).max() < 0.04


def test_what_cannot_be_added_is_said(room, tmp_path, capsys):
    scene = room / "scene"
    with pytest.raises(UserError, match="no new photos"):
        _run(scene, "--add")
    with pytest.raises(UserError, match="--poses does not go with --add"):
        _run(scene, "--add", "--poses", str(scene / "sparse" / "0"))
    shutil.copytree(room / "all", tmp_path / "other" / "input")
    with pytest.raises(UserError, match="leave --add out"):
        _run(tmp_path / "other", "--add")
    _put(room, *LATER)
    (scene / "input" / "photo_00.png").unlink()
    with pytest.raises(UserError, match=r"lacks photo_00\.png; put them back"):
        _run(scene, "--add")
    (tmp_path / "masks").mkdir()
    with pytest.raises(UserError, match="has a mask"):  # by the first stage
        _run(scene, "--mask_path", str(tmp_path / "masks"))
    assert "without --add, photos that were added before get new poses" in capsys.readouterr().err
    assert not (scene / "distorted" / "base").exists()


def test_photos_that_are_prepared_under_other_names_are_known(tmp_path):
    """By files of kinds that COLMAP does not read, or without a suffix; the model is not asked."""
    layout, names = Layout(tmp_path), ["a.webp", "b.jp2", "c", "d.avif", "e.png"]
    layout.input.mkdir()
    for name, kind in zip(names, ("WEBP", "JPEG2000", "TIFF", "AVIF", "PNG"), strict=True):
        Image.new("RGB", (32, 24)).save(layout.input / name, kind)
    prepare_images(layout, names, None)
    with pytest.raises(UserError, match="has no new photos"):
        keep_base(layout, True, names)
    layout.base.mkdir()
    with contextlib.closing(sqlite3.connect(layout.base_database)) as database:
        database.execute("CREATE TABLE images (name TEXT)")
        database.executemany("INSERT INTO images VALUES (?)", [(name,) for name in image_names(layout.prepared)])
        database.commit()
    keep_base(layout, False, [*names, "new.png"])
    with pytest.raises(UserError, match=r"lacks a\.webp; put them back"):
        keep_base(layout, False, names[1:])
