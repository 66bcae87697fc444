"""convert.py: scenes from photos taken at known places, second runs, interruptions, messages for mistakes."""

import json
import os
import shlex
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from photo_room import FISHEYE, FOCAL, SIZE, cam_to_world, camera_centers, make_photos
from PIL import Image
from synthetic import folder_state

import convert
import train
from applications.convert import capture_page, stages
from applications.convert.colmap import Pycolmap, Settings
from applications.convert.images import check_images, prepare_images
from applications.convert.layout import Layout, refuse_foreign_results
from applications.convert.stages import reconstruction_stages
from scene.checks.conversion import check_conversion, describe_left_out, is_unfinished
from scene.dataset_readers import read_scene
from scene.readers.scene_folder import is_scene
from scene.readers.tracks import read_tracks
from utils.system_utils import UserError

VIEWS = 8
SETTINGS = Settings("OPENCV", 8192, "exhaustive", "incremental", no_gpu=True)
NAMES = ["photo_00.png", "photo_01.png", "Ünser Bild 2.png", "deep/photo_03.png"]
NAMES += ["photo_04.png", "photo_05.png", "photo_06.png", "photo_07.jpg"]


def _photos(scene: Path) -> None:
    """Images of a room in `input`, with a sub-folder, blanks and an umlaut in names, and one turned by EXIF."""
    make_photos(scene / "input", VIEWS)
    (scene / "input" / "deep").mkdir()
    for number, name in enumerate(NAMES):
        (scene / "input" / f"photo_{number:02d}.png").rename(scene / "input" / Path(name).with_suffix(".png"))
    plain, exif = scene / "input" / "photo_07.png", Image.Exif()
    exif[0x0112] = 6  # "turn by 90 degrees clockwise to see it upright"
    exif[0x010F] = "maker"
    Image.open(plain).transpose(Image.Transpose.ROTATE_90).save(plain.with_suffix(".jpg"), quality=97, exif=exif)
    plain.unlink()
    (scene / "input" / "clip.AAE").write_text("<plist/>")


def _convert(scene: Path) -> None:
    _photos(scene)
    before = folder_state(scene / "input")
    convert.main(["-s", str(scene), "--no_gpu", "--resize"])
    assert folder_state(scene / "input") == before


@pytest.fixture(scope="module")
def converted(once) -> Path:
    return once("my room", _convert)


@pytest.fixture
def copy(converted: Path, tmp_path: Path) -> Path:
    """A copy of the converted scene, which tests may change."""
    return Path(shutil.copytree(converted, tmp_path / "copy", copy_function=shutil.copy2))


@pytest.mark.slow
def test_every_photo_is_placed_where_it_was_taken(converted):
    info = read_scene(converted, "images", hold_out=False)
    assert [camera.image_name for camera in info.train_cameras] == sorted(NAMES, key=os.fsencode)
    for camera in info.train_cameras:
        assert camera.file_size == (camera.width, camera.height)
        # Without distortion the crop is small, and the error of the focal length is below 2 %.
        assert abs(camera.width - SIZE[0]) < 12 and abs(camera.height - SIZE[1]) < 12
        assert camera.fx == pytest.approx(FOCAL, rel=0.02)
    _check_places(pycolmap.Reconstruction(converted / "sparse" / "0"), NAMES, "PINHOLE")
    own = ["capture.html", "convert_report.json", "distorted", "images", "images_2", "images_4", "images_8", "input"]
    assert sorted(path.name for path in converted.iterdir()) == [*own, "sparse"]
    content = json.loads((converted / "convert_report.json").read_text())
    assert list(content) == sorted(content)
    assert (content["registered"], content["photos"], content["left_out"], content["advice"]) == (VIEWS, VIEWS, {}, [])
    assert content["unused"] == {"clip.AAE": "no picture"}
    assert content["points"] > 1000 and content["more_points"] > 1000
    assert content["points"] + content["more_points"] == len(info.point_cloud.points)
    for name in NAMES:
        with Image.open(converted / "images" / name) as whole:
            for factor in (2, 4, 8):
                with Image.open(converted / f"images_{factor}" / name) as small:
                    assert small.size == (round(whole.width / factor), round(whole.height / factor))


def _check_places(model: pycolmap.Reconstruction, names: list[str], camera: str) -> None:
    assert {camera.model_name for camera in model.cameras.values()} == {camera}
    places = camera_centers(len(names))
    ransac = pycolmap.RANSACOptions()
    ransac.max_error = 0.05
    transform = pycolmap.align_reconstruction_to_locations(model, names, places, len(names), ransac)
    assert transform is not None
    model.transform(transform)
    found = np.array([model.find_image_with_name(name).projection_center() for name in names])
    # The bound is 1 % of the cameras' distance to the corner, some 4.
    assert np.abs(found - places).max() < 0.04


def test_a_second_run_does_only_what_changed(copy, capsys):
    scene = folder_state(copy)
    convert.main(["-s", str(copy), "--no_gpu", "--resize"])
    out = capsys.readouterr().out
    assert "reused from an earlier run: photos, features, matching, mapping, undistortion, capture, resize" in out
    assert folder_state(copy) == scene
    features = Layout(copy).database.read_bytes()
    # Resized copies of the old photos must not stay beside new ones.
    convert.main(["-s", str(copy), "--no_gpu", "--mapper", "global"])
    out = capsys.readouterr().out
    assert "reused from an earlier run: photos, features, matching;" in out
    assert f"{VIEWS} of {VIEWS} photos placed" in out
    assert not (copy / "images_2").exists()
    # The focal lengths that global mapping estimates must not get into the database that later runs resume from.
    assert Layout(copy).database.read_bytes() == features
    assert len(read_scene(copy, "images", False).train_cameras) == VIEWS
    # Those of a user stay, and a link goes without what it leads to.
    record = json.loads(Layout(copy).stages.read_text())
    Layout(copy).stages.write_text(json.dumps({name: entry for name, entry in record.items() if name != "resize"}))
    (copy / "images_2").mkdir()
    (copy / "images").rename(copy / "elsewhere")
    (copy / "images").symlink_to(copy / "elsewhere")
    convert.main(["-s", str(copy), "--no_gpu", "--mapper", "global", "--lenses", "native"])
    assert (copy / "images_2").is_dir() and any((copy / "elsewhere").iterdir())
    assert len(read_scene(copy, "images", False).train_cameras) == VIEWS and not (copy / "images").is_symlink()


def test_the_command_that_trains_can_be_copied(copy, monkeypatch, capsys):
    """The command ends the output, unless too few photos are placed."""
    inputs, found = convert.record_inputs, {"again": ["Use a fixed exposure, or train these with --appearance ppisp"]}
    monkeypatch.setattr(convert, "record_inputs", lambda *a, **k: inputs(*a, **k) | found)
    convert.main(["-s", str(copy), "--no_gpu", "--resize"])
    words = shlex.split(capsys.readouterr().out.splitlines()[-1].removeprefix("train it with: "))
    assert words[-7:] == ["-s", str(copy), "-m", f"output/{copy.name}", "--eval", "--appearance", "ppisp"]
    found["registered"] = 2
    with pytest.raises(SystemExit, match="3"):
        convert.main(["-s", str(copy), "--no_gpu", "--resize"])
    out, err = capsys.readouterr()
    assert "train it with" not in out and "only 2 of 8 photos are placed" in err


def test_the_same_command_gives_the_same_scene(converted, tmp_path):
    """With one thread; `applications/convert/worker.py` says why."""
    _convert(tmp_path)

    def bytes_of(scene: Path) -> dict[str, bytes]:
        files = [path for part in ("sparse", "images") for path in (scene / part).rglob("*") if path.is_file()]
        return {str(path.relative_to(scene)): path.read_bytes() for path in files}

    assert bytes_of(tmp_path) == bytes_of(converted)


def test_a_model_made_elsewhere_is_undistorted(copy, capsys):
    other = copy.parent / "other"
    shutil.copytree(copy / "distorted" / "photos", other / "input")
    shutil.copytree(copy / "distorted" / "sparse", other / "distorted" / "sparse")
    with pytest.raises(UserError, match="already has distorted, which convert.py did not make.*--skip_matching"):
        convert.main(["-s", str(other)])
    # A model of two photos that comes first must not be chosen.
    small = other / "distorted" / "sparse" / "0"
    small.rename(small.with_name("1"))
    small.mkdir()
    model = pycolmap.Reconstruction(small.with_name("1"))
    for frame in sorted(model.reg_frame_ids())[2:]:
        model.deregister_frame(frame)
    model.write_binary(str(small))
    convert.main(["-s", str(other), "--skip_matching", "--camera", "PINHOLE", "--mapper", "global"])
    assert "warning: --skip_matching ignores --camera, --mapper, as the model is there" in capsys.readouterr().err
    assert len(read_scene(other, "images", False).train_cameras) == VIEWS
    assert json.loads((other / "convert_report.json").read_text())["model"] == "1"


def test_photos_that_share_nothing(tmp_path):
    (tmp_path / "input").mkdir()
    for number in range(3):
        noise = np.random.default_rng(number).integers(0, 256, (60, 80, 3), dtype=np.uint8)
        Image.fromarray(noise).resize((160, 120)).save(tmp_path / "input" / f"{number}.png")
    with pytest.raises(UserError, match="none of 3 photos could be placed: no two of them .*overlap by 60 to 80 %"):
        convert.main(["-s", str(tmp_path), "--no_gpu", "--mapper", "incremental"])
    assert not (tmp_path / "images").exists()


def _given(folder: Path, count: int) -> Path:
    """Write transforms.json with the poses of make_photos's photos, of cameras twice as large; return its path."""
    frames = []
    for number, center in enumerate(camera_centers(count)):
        pose = np.eye(4)
        pose[:3] = np.column_stack([cam_to_world(center) * (1, -1, -1), center])  # y up, z backward
        frames.append({"file_path": f"./images/photo_{number:02d}", "transform_matrix": pose.tolist()})
    (width, height), path = SIZE, folder / "transforms.json"
    content = {"w": 2 * width, "h": 2 * height, "fl_x": 2 * FOCAL, "frames": frames}
    folder.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def _edited(old: str, new: str) -> str:
    """A command that changes words in the file of the given poses."""
    return f"sed -i 's#{old}#{new}#g' transforms.json"


@pytest.mark.parametrize(("words", "change", "said"), [
    ("-s {}", "mv input images", r"rename its folder images to input"),
    ("-s {}", "mv input else", r"rename its folder else to input and run .*convert.py -s .*room$"),
    ("-s {}", "mkdir -p else.pdf/a; mv input else.pdf/a/b", r"make it and put the photos there, or pass"),
    ("-s {}", "mv input depth; touch rgb.mp4", r"no folder input in .*room; run .*convert.py -s .*room --video .*/rgb"),
    ("-s {}/else", "mv input else; touch transforms.json", r"no folder input in .*else, which lies in a scene already"),
    ("-s {}", "mkdir images", r"already has images, which convert.py did not make"),
    ("-s {}", "touch capture.html", r"already has capture.html, which convert.py did"),
    ("-s {} --resize", "mkdir images_4", r"did not make .*images_4, and --resize would"),
    ("-s {}", "cd input; rm photo_0[12]*; touch walk.mp4", r"photos .1.; add .*walk.mp4 \(video: pass it as --video"),
    ("-s {}", "touch input/1.HEIC", r"cannot be read: 1.HEIC \(damaged"),
    ("-s {}/input", "", r"room/input is the folder of the photos itself; pass its parent folder as -s: .*room$"),
    ("-s {}/nowhere", "", r"no folder .*nowhere; make it, put the photos into a folder input"),
    ("-s '{}'", "", r"contains quotes: '.*room'; pass /.*room, quoted only once for the shell"),
    ("-s {}", "mv input/* .; rmdir input; touch cfg_args", r"room is a model that train.py wrote; pass the folder"),
    ("-s {}", "mv input images; touch transforms.json", r"no folder input in .*room, which is a scene already: train"),
    ("-s {}/input/photo_00.png", "", r"photo_00.png is a file; pass the folder that contains"),
    ("-s {} --camera PINHOLEY", "", r"--camera PINHOLEY is not a supported lens model.*OPENCV_FISHEYE"),
    ("-s {} --camera EQUIRECTANGULAR --lenses undistort", "", r"no pinhole image shows a panorama; omit --len"),
    ("-s {} --poses no", "", r"no poses in no; pass a transforms.json, or the folder of cameras.txt"),
    ("-s {} --poses x --mapper global", "", r"--mapper does not go with --poses, which gives poses and lenses"),
    ("-s {} --mask_path no", "", r"no folder of masks 'no'; pass an existing folder"),
    ("-s {} --mask_path {}", "", r"none of 3 photos has a mask .*photo_00.png.png"),
    ("-s {} --max_num_features 0", "", r"--max_num_features must be at least 100, got 0"),
    ("-s {} --skip_matching", "", r"--skip_matching needs a COLMAP model in .*distorted/sparse"),
    ("-s {} --colmap_executable /no/colmap", "", r"cannot run --colmap_executable /no/colmap"),
    ("-s {} --poses", _edited('"w": 480', '"w": 360'), "photo_00.png has 40 x 30 pixels .* 360 x 360; use the"),
    ("-s {} --poses", _edited("photo_0", "frame_"), "0 photos of .*input have a pose in .*lists ./images/frame"),
    ("-s {} --poses", _edited("photo_01", "left/photo_02"), "photo_02 and .*photo_02 in .* of the photo photo_02"),
    ("-s {} --poses", _edited("transform_matrix", "pose"), "frame 1 .* has no transform_matrix"),
])  # fmt: skip
def test_slips_get_one_sentence(tmp_path, words, change, said):
    """change: a command in the folder of the scene."""
    scene, poses = tmp_path / "room", []
    (scene / "input").mkdir(parents=True)
    for number in range(3):
        Image.new("RGB", (40, 30)).save(scene / "input" / f"photo_{number:02d}.png")
    if words.endswith("--poses"):
        poses = [str(_given(scene, 3))]
    subprocess.run(change, shell=True, cwd=scene, check=True)
    with pytest.raises(UserError, match=said) as error:
        convert.main([word.replace("{}", str(scene)) for word in words.split()] + poses)
    assert "\n" not in str(error.value) and not (scene / "sparse").exists()


@pytest.mark.slow
def test_a_finished_scene_stays_until_the_next_one_is_there(copy, monkeypatch):
    """The record still knows that convert.py made it."""

    def scene() -> dict:
        return {
            name: state for name, state in folder_state(copy).items() if not name.startswith(("input", "distorted"))
        }

    before, work = scene(), folder_state(copy / "distorted")
    assert {"images", "images_2", "sparse"} <= {Path(name).parts[0] for name in before}
    words = ["-s", str(copy), "--no_gpu"]
    with pytest.raises(UserError, match="none of 8 photos has a mask"):
        convert.main([*words, "--mask_path", str(copy.parent)])
    assert scene() == before and folder_state(copy / "distorted") == work
    monkeypatch.setattr(stages, "refuse_unplaced", lambda *_: (_ for _ in ()).throw(UserError("no model")))
    with pytest.raises(UserError, match="no model"):
        convert.main([*words, "--mapper", "global"])
    assert scene() == before


def _interrupt(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


@pytest.mark.slow
def test_a_verdict_outlives_an_interruption_and_train_finishes_what_was_begun(copy, monkeypatch):
    """The folder is a scene only when photos and verdict are there, too."""
    verdict, again = "no way of mapping", ["-s", str(copy), "--no_gpu", "--lenses"]
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(stages.report, "why_unusable", lambda _: verdict)
        patch.setattr(capture_page, "write_page", _interrupt)
        convert.main([*again, "native"])
    assert verdict in describe_left_out(copy) and is_scene(copy) and is_unfinished(copy)
    assert [line for line in map(str, check_conversion(copy)) if f"says of this scene: {verdict}" in line]
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(stages.report, "write_report", _interrupt)
        convert.main([*again, "undistort"])
    assert not is_scene(copy) and (copy / "images").is_dir()
    with pytest.raises(StopIteration):  # in place of the training
        monkeypatch.setattr(train, "safe_state", lambda *_: next(iter(())))
        train.main(["-s", str(copy), "-m", str(copy / "out")])
    report = json.loads((copy / "convert_report.json").read_text())
    assert (report["lenses"], report["unusable"]) == ("undistort", None) and not is_unfinished(copy)
    (copy / "convert_report.json").write_text("{")
    with pytest.raises(UserError, match="a report in .* is damaged; remove .*distorted to begin anew"):
        convert.main([*again, "undistort"])
    (copy / "convert_report.json").write_text(json.dumps(report))
    shutil.rmtree(copy / "distorted")
    refuse_foreign_results(Layout(copy), False, False, False)  # as the line says


def test_masks_keep_features_away(converted, tmp_path):
    layout = Layout(tmp_path / "scene")
    masks = tmp_path / "masks"
    for folder in (layout.input, masks / "deep"):
        folder.mkdir(parents=True)
    for name in (*NAMES[:2], NAMES[3]):
        (layout.input / name).parent.mkdir(exist_ok=True)
        shutil.copy(converted / "input" / name, layout.input / name)
    half = Image.new("L", SIZE)
    half.paste(255, (SIZE[0] // 2, 0, *SIZE))
    half.save(masks / "photo_00.png.png")
    half.convert("RGB").save(masks / "deep" / "photo_03.png")
    prepare_images(layout, [*NAMES[:2], NAMES[3]], masks)
    features, *_ = reconstruction_stages(Pycolmap(layout, SETTINGS), masks=True)
    features.work()
    database = pycolmap.Database.open(str(layout.database))
    rows = {image.name: database.read_keypoints(image.image_id) for image in database.read_all_images()}
    for name in ("photo_00.png", "deep/photo_03.png"):
        assert len(rows[name]) > 50 and rows[name][:, 0].min() > SIZE[0] / 2 - 1
    # A photo without a mask is used whole.
    assert rows["photo_01.png"][:, 0].min() < SIZE[0] / 4
    database.close()


@pytest.mark.slow
def test_panoramas_are_placed_and_taken_as_they_are(tmp_path):
    make_photos(tmp_path / "input", 4, panoramas=True)
    words = ["-s", str(tmp_path), "--no_gpu", "--camera", "EQUIRECTANGULAR"]
    convert.main(words)
    views = read_scene(tmp_path, "images", hold_out=False, native=True).train_cameras
    assert all(view.native.chart == "equirectangular" and view.width == 512 for view in views)
    shots = sorted((tmp_path / "input").iterdir())
    assert [path.read_bytes() for path in shots] == [view.image_path.read_bytes() for view in views]
    _check_places(pycolmap.Reconstruction(tmp_path / "sparse" / "0"), [path.name for path in shots], "EQUIRECTANGULAR")
    Image.new("RGB", (60, 40)).save(tmp_path / "input" / "small.png")
    with pytest.raises(UserError, match="small.png is not twice as wide as high, as panoramas of 360 by 180 degrees"):
        convert.main(words)


@pytest.mark.slow
def test_fisheyes_are_placed_and_stay_as_they_are(tmp_path, capsys):
    make_photos(tmp_path / "input", 6, lens=FISHEYE)
    shots = sorted((tmp_path / "input").iterdir())
    words = ["-s", str(tmp_path), "--no_gpu", "--camera", FISHEYE.model]

    def converted(*options: str) -> tuple[str, list]:
        convert.main([*words, *options])
        report = json.loads((tmp_path / "convert_report.json").read_text())
        return report["lenses"], read_scene(tmp_path, "images", hold_out=False, native=True).train_cameras

    lenses, views = converted()
    assert lenses == "native"
    assert [path.read_bytes() for path in shots] == [view.image_path.read_bytes() for view in views]
    # The photos tell no focal length, and where the fit begins is 6 % off.
    assert all(view.native.focal == pytest.approx(FISHEYE.params[:2], rel=0.01) for view in views)
    _check_places(pycolmap.Reconstruction(tmp_path / "sparse" / "0"), [path.name for path in shots], FISHEYE.model)
    lenses, views = converted("--lenses", "undistort")
    assert "reused from an earlier run: photos, features, matching, mapping;" in capsys.readouterr().out
    assert lenses == "undistort" and all(view.native is None for view in views)
    assert shots[0].read_bytes() != views[0].image_path.read_bytes()


@pytest.mark.slow
def test_points_are_computed_at_given_poses(tmp_path, capsys):
    make_photos(tmp_path / "input", VIEWS + 1)
    poses, names = _given(tmp_path / "phone", VIEWS + 1), [f"photo_{k:02d}.png" for k in range(VIEWS)]
    content = json.loads(poses.read_text())
    content["frames"] = [*content["frames"][:-1], {**content["frames"][0], "file_path": "images/gone.png"}]
    poses.write_text(json.dumps(content))
    words = ["-s", str(tmp_path), "--no_gpu", "--poses"]
    convert.main([*words, str(poses)])
    assert "1 of 9 photos have no pose in the file and were left out (photo_08.png)" in capsys.readouterr().err

    def judge() -> None:
        model = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
        found = np.array([model.find_image_with_name(name).projection_center() for name in names])
        np.testing.assert_allclose(found, camera_centers(VIEWS + 1)[:VIEWS], atol=1e-12)
        assert model.cameras[1].params == pytest.approx((FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2))
        # The walls are the planes x = 0, y = 0 and z = 0, some 4 units away, where a pixel is 0.02 units.
        off = np.abs([point.xyz for point in model.points3D.values()]).min(axis=1)
        assert len(off) > 1000 and np.median(off) < 0.005 and np.percentile(off, 95) < 0.04
        alone = np.array([not point.track.length() for point in model.points3D.values()])  # of dense_points.py
        assert alone.sum() > 1000 and np.median(off[alone]) < 0.01 and np.percentile(off[alone], 95) < 0.04
        views = read_scene(tmp_path, "images", hold_out=False).train_cameras
        assert all(read_tracks(tmp_path, views, np.zeros(3)))

    judge()
    # A text model without points, as other programs write it, with axes of another convention: no pose is where the
    # photo shows it to be.
    model = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    (tmp_path / "model").mkdir()
    model.write_text(str(tmp_path / "model"))
    for name in ("points3D", "rigs", "frames"):
        (tmp_path / "model" / f"{name}.txt").unlink()
    lines = []
    for image in model.images.values():
        (x, y, z, w), (right, down, ahead) = image.cam_from_world().rotation.quat, image.cam_from_world().translation
        lines.append(f"{image.image_id} {-x} {w} {-z} {y} {right} {-down} {-ahead} 1 {image.name}\n\n")
    (tmp_path / "model" / "images.txt").write_text("".join(lines))
    before = folder_state(tmp_path / "sparse")
    with pytest.raises(UserError, match=r"the photos do not fit the given poses \(\d points.*or omit --poses"):
        convert.main([*words, str(tmp_path / "model")])
    assert folder_state(tmp_path / "sparse") == before


def test_photos_and_masks_that_can_not_be_used_are_named_at_once(tmp_path):
    layout, names = Layout(tmp_path / "scene"), [f"{letter}.jpg" for letter in "abcde"]
    masks, exif = tmp_path / "masks", Image.Exif()
    layout.input.mkdir(parents=True)
    masks.mkdir()
    exif[0x0112] = 6
    for name in names:
        Image.new("RGB", (40, 30)).save(layout.input / name, exif=exif)
        Image.new("L", (30, 40)).save(masks / f"{name}.png")
    check_images(layout, names, masks)
    (layout.input / "b.jpg").write_bytes((layout.input / "b.jpg").read_bytes()[:-60])
    (layout.input / "c.jpg").write_bytes(b"<html>")
    Image.new("L", (40, 30)).save(masks / "e.jpg.png")
    said = "^3 of 5 photos cannot be used: .*b.jpg.*c.jpg.*mask .*e.jpg.png has 40 x 30 pixels, .*--skip_unreadable"
    with pytest.raises(UserError, match=said) as error:
        check_images(layout, names, masks)
    assert "\n" not in str(error.value) and "a.jpg" not in str(error.value) and "d.jpg" not in str(error.value)
