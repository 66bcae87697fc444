"""convert.py's cameras: which photos share one, by EXIF, folders or choice; what it says of them; the doctor's word."""

import json
import re
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from photo_room import FOCAL, SIZE, camera_centers, make_photos
from PIL import ExifTags, Image

import convert
from applications.convert import cameras
from applications.convert.checks import check_shared_cameras
from applications.convert.layout import Layout
from scene.checks.cameras import check_lenses
from scene.dataset_readers import read_scene
from scene.images.exif import Lens, read_lens

TAGS = ExifTags.Base
VIEWS = 10
TELE = 1.6  # its focal length by that of the other lens
FILM = 36.0 * FOCAL / SIZE[0]  # mm that frame as FOCAL does, were film as high as the photos
DEVICE = {TAGS.Make: "Maker", TAGS.Model: "Phone 3"}
CAM = {TAGS.Make: "Cam", TAGS.Model: "Cam 5"}
NAMES = [f"photo_{number:02d}.jpg" for number in range(VIEWS)]


def exif(device: dict | None = None, **more: object) -> Image.Exif:
    """EXIF data by names of tags."""
    made = Image.Exif()
    made.update(DEVICE if device is None else device)
    made.get_ifd(ExifTags.IFD.Exif).update({TAGS[tag]: value for tag, value in more.items()})
    return made


def small(path: Path, made: Image.Exif | None = None, size: tuple[int, int] = (8, 6)) -> str:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size).save(path, exif=Image.Exif() if made is None else made)
    return path.name


@pytest.mark.parametrize(("made", "found", "said"), [
    (exif({}), Lens(), "a lens that EXIF does not name"),
    (exif(), Lens("Maker", "Phone 3"), "Maker Phone 3"),
    (exif(FocalLength=6.86, FocalLengthIn35mmFilm=48, LensModel="back \x00"),
     Lens("Maker", "Phone 3", "back", 6.86, 48), "Maker Phone 3, back, 6.86 mm (as 48 mm on 35 mm film)"),
    (exif(CAM, FocalLengthIn35mmFilm=35), Lens("Cam", "Cam 5", film=35), "Cam 5, as 35 mm on 35 mm film"),
    (exif(CAM, FocalLength=4.0, DigitalZoomRatio=2.0), Lens("Cam", "Cam 5", focal=4, zoom=2),
     "Cam 5, 4 mm, digital zoom 2"),
    (exif(CAM, FocalLength=4.0, DigitalZoomRatio=1.0), Lens("Cam", "Cam 5", focal=4), "Cam 5, 4 mm"),
    (exif(CAM, FocalLength=4.0, DigitalZoomRatio=0.0), Lens("Cam", "Cam 5", focal=4), "Cam 5, 4 mm"),
])  # fmt: skip
def test_lenses_are_read_and_named(tmp_path, made, found, said):
    for suffix in ("jpg", "png", "webp"):
        small(tmp_path / f"a.{suffix}", made)
        assert read_lens(tmp_path / f"a.{suffix}") == found
    assert str(found) == said


def test_damaged_exif_names_no_lens(tmp_path):
    made = exif(FocalLength=float("nan"), FocalLengthIn35mmFilm=(1, 2), LensModel=b"\xff\xfe")
    assert read_lens(tmp_path / small(tmp_path / "a.jpg", made)).length == 0
    (tmp_path / "b.jpg").write_bytes((tmp_path / "a.jpg").read_bytes().replace(b"Exif\0\0MM\0*", b"Exif\0\0XX\0*"))
    assert read_lens(tmp_path / "b.jpg") == read_lens(tmp_path / "missing.jpg") == Lens()


LENS = {"LensModel": "back", "FocalLength": 4.0, "FocalLengthIn35mmFilm": 26}
SHOTS = {
    "a.jpg": exif(**LENS),
    "b.jpg": exif(**LENS | {"FocalLengthIn35mmFilm": 52}),  # the same lens, of which the device shows the middle
    "c.jpg": exif(**LENS | {"DigitalZoomRatio": 2.0}),
    "d.jpg": exif(**LENS | {"FocalLength": 6.0}),
    "e.jpg": exif({TAGS.Make: "Maker", TAGS.Model: "Phone 4"}, **LENS),
    "f.jpg": exif(**LENS | {"LensModel": "front"}),
    "x/g.jpg": exif(**LENS),
    "x/h.jpg": exif({}),
    "x/i.png": exif({}),
    "y/j.jpg": exif({}),
    "y/k.jpg": exif(),
    "y/l.jpg": exif(**LENS),
}


@pytest.mark.parametrize(("mode", "found"), [
    ("per_lens", ["ag", "b", "c", "d", "e", "f", "hi", "j", "k", "l"]),
    ("per_folder", ["abcdef", "ghi", "jk", "l"]),
    ("per_photo", [*"abcdefghijkl"]),
    ("shared", ["abcdefghijk", "l"]),
])  # fmt: skip
def test_who_shares_a_camera(tmp_path, mode, found):
    for name, made in SHOTS.items():
        small(tmp_path / name, made, (8, 6) if "l" not in Path(name).stem else (6, 8))
    groups = cameras.group_photos(tmp_path, [*SHOTS], mode)
    assert ["".join(Path(name).stem for name in one.names) for one in groups] == found
    said = cameras.describe_groups(groups)
    if mode == "per_folder":
        assert f"  3 photos, 8 x 6 in x: Maker Phone 3, back, 4 mm (as 26 mm on 35 mm film) and {Lens()}" in said
    assert len(said.splitlines()) == (1 if mode == "per_photo" else len(found) + 1)


def photos(scene: Path) -> None:
    """Photos of a room, every second one through another lens; EXIF says so."""
    make_photos(scene / "input", VIEWS, focals=(FOCAL, TELE * FOCAL))
    for number, path in enumerate(sorted((scene / "input").iterdir())):
        film = round(FILM * TELE ** (number % 2))
        made = exif(FocalLengthIn35mmFilm=film, LensModel=("wide", "tele")[number % 2])
        Image.open(path).save(path.with_suffix(".jpg"), quality=97, subsampling=0, exif=made)
        path.unlink()


def strayed(scene: Path) -> np.ndarray:
    """Distances of the cameras' places from where photos were taken, after a similarity, in units of the room."""
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    names = [name for name in NAMES if model.find_image_with_name(name)]
    found = np.array([model.find_image_with_name(name).projection_center() for name in names])
    true = camera_centers(VIEWS)[[NAMES.index(name) for name in names]]
    fit = pycolmap.estimate_sim3d(found, true)
    return np.linalg.norm(fit * found - true, axis=1)


@pytest.mark.slow
def test_each_lens_gets_its_camera(tmp_path, capsys):
    photos(tmp_path)
    convert.main(["-s", str(tmp_path), "--no_gpu"])
    assert strayed(tmp_path).max() < 0.02  # of 4 to the corner
    wide, tele = (f"Maker Phone 3, {lens}, as {film} mm on 35 mm film" for lens, film in (("wide", 33), ("tele", 53)))
    assert f"2 cameras:\n  5 photos, 240 x 180: {wide}\n  5 photos, 240 x 180: {tele}\n" in capsys.readouterr().out
    report = json.loads((tmp_path / "convert_report.json").read_text())
    assert (report["registered"], report["shared_by"], report["advice"]) == (VIEWS, "per_lens", [])
    said = {camera["lenses"][0]: (camera["registered"], camera["photos"]) for camera in report["cameras"]}
    assert said == {wide: (5, NAMES[::2]), tele: (5, NAMES[1::2])}
    for camera in read_scene(tmp_path, "images", hold_out=False).train_cameras:
        assert camera.fx == pytest.approx(FOCAL * TELE ** (NAMES.index(camera.image_name) % 2), rel=0.02)
    assert not [*check_lenses(str(tmp_path), read_scene(tmp_path, "images", hold_out=False).train_cameras)]
    database = pycolmap.Database.open(str(Layout(tmp_path).database))
    first = [camera.params[0] for camera in database.read_all_cameras() if camera.has_prior_focal_length]
    database.close()
    # As wide as on film means here: as much of the diagonal, 43.27 mm.
    assert first == pytest.approx([film * np.hypot(*SIZE) / np.hypot(36, 24) for film in (33, 53)], rel=1e-3)


def survey(*factors: float, gain: float = 0.5) -> list[dict]:
    """One camera, whose photos have a focal length of their own with which their error is `gain` times as large."""
    return [{"photos": {f"{number}.jpg": [factor, 0.8, 0.8 * gain] for number, factor in enumerate(factors)}}]


def _advice(*words) -> list[str]:
    return [*map(str, check_shared_cameras(*words))]


@pytest.mark.parametrize(("found", "said"), [
    (survey(*[1.005] * 9), None),
    (survey(1.2, 0.9, *[1.0] * 7), None),  # two may be wrong for other reasons
    (survey(1.2, 0.9, 1.1, *[1.0] * 77), None),
    (survey(1.2, 0.9, 1.1, *[1.0] * 7, gain=0.95), None),
    (survey(1.2, 0.9, 1.1, *[1.0] * 7), r"3 of 10 photos .* \(0.jpg, 1.jpg, 2.jpg\) .* 0.90 to 1.20 times"),
])  # fmt: skip
def test_photos_of_another_focal_length_are_named(found, said):
    found[0]["photos"]["few points.jpg"] = []
    lines = _advice(found, {}, "shared")
    if said:
        (line,) = _advice(found, {"0.jpg": Lens(film=26), "1.jpg": Lens(film=52)}, "shared")
        assert line.endswith("convert again with --cameras per_lens")
    assert len(lines) == (said is not None) and (not said or re.search(said.replace("of 10", "of 11"), lines[0]))


@pytest.mark.parametrize(("mode", "known", "frames", "count"), [
    ("per_lens", "yyn", "", 1), ("per_lens", "yyy", "", 0), ("per_lens", "nnn", "", 0), ("shared", "yyn", "", 0),
    ("per_lens", "ynnn", "23", 1), ("per_lens", "ynnn", "123", 0), ("per_lens", "ynnn", "023", 0),
])  # fmt: skip
def test_photos_without_exif_among_others_are_named(mode, known, frames, count):
    """frames: photos that are of a video, which need none."""
    lenses = {f"{number}.jpg": Lens(film=26.0 * (has == "y")) for number, has in enumerate(known)}
    lines = _advice([], lenses, mode, {f"{number}.jpg" for number in frames})
    assert len(lines) == count and all("photos name no lens" in line for line in lines)
    assert count == 0 or frames or "1 of 3 photos name no lens (2.jpg), and" in lines[0]


def test_the_doctor_compares_cameras_with_exif(colmap_scene):
    """Also where the program that made the scene kept no EXIF data, but the photos that convert.py read are there."""
    views = read_scene(colmap_scene, "images", hold_out=False).train_cameras
    assert not [*check_lenses(str(colmap_scene), views)]
    for number, view in enumerate(views):
        made = exif(FocalLength=4.0 + 2 * (number >= 12))
        path = view.image_path if number % 2 else colmap_scene / "input" / view.image_name
        small(path, made, (view.width, view.height))
    (line,) = check_lenses(str(colmap_scene), views)
    said = "17 photos share one camera, but their EXIF data tell several focal lengths: 4 mm (12), 6 mm (5)"
    assert line.is_problem and line.text == said and "--cameras per_lens" in line.remedy
    halves = [view._replace(fx=view.fx * (1 + (number >= 12))) for number, view in enumerate(views)]
    assert not [*check_lenses(str(colmap_scene), halves)]
