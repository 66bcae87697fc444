"""convert.py: scenes from photos taken at known places, second runs, interruptions, messages for mistakes."""

import contextlib
import json
import os
import re
import shlex
import shutil
import signal
import stat
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from photo_room import FISHEYE, FOCAL, SIZE, cam_to_world, camera_centers, make_photos
from PIL import Image
from synthetic import folder_state
from waiting import LIMIT, wait_for

import convert
from scene.dataset_readers import read_scene
from scene.readers.tracks import read_tracks
from splatting.findings.capture import Look, of_model, worth
from splatting.sfm import colmap, programs, report
from splatting.sfm.colmap import LENS_MODELS, Program, Pycolmap, Settings
from splatting.sfm.images import check_images, find_masks, prepare_images
from splatting.sfm.layout import Layout
from splatting.sfm.programs import refuse_while_working, run_programs
from splatting.sfm.stages import Stage, StageRecord, reconstruction_stages
from utils.system_utils import UserError

ROOT = Path(__file__).resolve().parent.parent
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
    assert len(info.point_cloud.points) > 1000
    for camera in info.train_cameras:
        assert camera.file_size == (camera.width, camera.height)
        # Without distortion the crop is small, and the error of the focal length is below 2 %.
        assert abs(camera.width - SIZE[0]) < 12 and abs(camera.height - SIZE[1]) < 12
        assert camera.fx == pytest.approx(FOCAL, rel=0.02)
    _check_places(pycolmap.Reconstruction(converted / "sparse" / "0"), NAMES, "PINHOLE")


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


def test_what_is_written(converted):
    assert sorted(path.name for path in converted.iterdir()) == [
        *("capture.html", "convert_report.json", "distorted"),
        *("images", "images_2", "images_4", "images_8", "input", "sparse"),
    ]
    content = json.loads((converted / "convert_report.json").read_text())
    assert list(content) == sorted(content)
    assert (content["registered"], content["photos"], content["left_out"], content["advice"]) == (VIEWS, VIEWS, {}, [])
    assert content["points"] > 1000 and content["more_points"] > 1000
    points = len(read_scene(converted, "images", False).point_cloud.points)
    assert content["points"] + content["more_points"] == points
    for name in NAMES:
        with Image.open(converted / "images" / name) as whole:
            for factor in (2, 4, 8):
                with Image.open(converted / f"images_{factor}" / name) as small:
                    assert small.size == (round(whole.width / factor), round(whole.height / factor))


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


@pytest.mark.parametrize("name", ["../a.png", "/a.png", "deep/../../a.png"])
def test_photos_of_a_model_stay_in_their_folder(tmp_path, name):
    layout = Layout(tmp_path)
    layout.work.mkdir()
    model = report.Model("0", [name], 1, 1.0, 1.0, [])
    layout.survey.write_text(json.dumps([model._asdict()]))
    with pytest.raises(UserError, match="names a photo .*a.png, outside of the folder of its photos"):
        report.read_survey(layout, [])


@pytest.mark.parametrize(
    ("placed", "stops", "more"), [(VIEWS, 0.0, []), (VIEWS, 1.0, ["--appearance", "ppisp"]), (2, 0.0, None)]
)
def test_the_command_that_trains_can_be_copied(copy, monkeypatch, capsys, placed, stops, more):
    """It ends the output, unless too few photos are placed."""
    looks = {name: Look(1.0, stops * (-1) ** number) for number, name in enumerate(NAMES)}
    photos = {name: {"shared": {other: 100 for other in NAMES if other != name}} for name in NAMES}
    found = worth(json.loads((copy / "convert_report.json").read_text()), photos, looks)
    inputs = convert.report_inputs
    monkeypatch.setattr(convert, "report_inputs", lambda *a, **k: inputs(*a, **k) | found | {"registered": placed})
    with pytest.raises(SystemExit, match="3") if more is None else contextlib.nullcontext():
        convert.main(["-s", str(copy), "--no_gpu", "--resize"])
    out, err = capsys.readouterr()
    if more is None:
        assert "train it with" not in out and "weakly" not in out and "only 2 of 8 photos are placed" in err
    else:
        words = shlex.split(out.splitlines()[-1].removeprefix("train it with: "))
        assert words[-len(more) - 5 :] == ["-s", str(copy), "-m", f"output/{copy.name}", "--eval", *more]
        assert "no photo is weakly connected" in out


@pytest.mark.slow
def test_the_same_command_gives_the_same_scene(tmp_path, monkeypatch):
    """With one thread; `splatting/sfm/worker.py` says why."""
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    scenes = tmp_path / "one", tmp_path / "two"
    for scene in scenes:
        _photos(scene)

    def bytes_of(scene: Path) -> dict[str, bytes]:
        files = [path for part in ("sparse", "images") for path in (scene / part).rglob("*") if path.is_file()]
        return {str(path.relative_to(scene)): path.read_bytes() for path in files}

    for mapper in ("incremental", "global"):
        for scene in scenes:
            convert.main(["-s", str(scene), "--no_gpu", "--mapper", mapper])
        one, two = map(bytes_of, scenes)
        assert one and one == two


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
        convert.main(["-s", str(tmp_path), "--no_gpu"])
    assert not (tmp_path / "images").exists()


def _photos_beside(scene: Path) -> None:
    (scene / "input").rename(scene / "away")
    for path in (scene / "away").iterdir():
        path.rename(scene / path.name)


def _trained(scene: Path) -> None:
    _photos_beside(scene)
    (scene / "cfg_args").touch()


def _converted(scene: Path) -> None:
    (scene / "input").rename(scene / "images")
    (scene / "transforms.json").touch()


def _few(scene: Path) -> None:
    for number in (1, 2):
        (scene / "input" / f"photo_0{number}.png").unlink()
    (scene / "input" / "walk.mp4").touch()


def _renamed(name: str) -> Callable[[Path], object]:
    return lambda scene: (scene / "input").rename(scene / name)


@pytest.mark.parametrize(
    ("words", "change", "said"),
    [
        ("-s {}", _photos_beside, r"no folder input in .*room, but 3 photos directly in it; make .*input, move them"),
        ("-s {}", _renamed("images"), r"rename its folder images to input"),
        ("-s {}", _renamed("else"), r"make it and put the photos there, or pass"),
        ("-s {}", lambda scene: (scene / "images").mkdir(), r"already has images, which convert.py did not make"),
        (
            "-s {}",
            lambda scene: (scene / "capture.html").touch(),
            r"already has capture.html, which convert.py did",
        ),
        ("-s {} --resize", lambda scene: (scene / "images_4").mkdir(), r"did not make .*images_4, and --resize would"),
        ("-s {}", _few, r"input: fewer than 3 readable photos .1.; add more.*walk.mp4 \(video: pass it as --video"),
        (
            "-s {}",
            lambda scene: (scene / "input" / "1.HEIC").touch(),
            r"cannot be read: 1.HEIC \(damaged",
        ),
        ("-s {}/input", None, r"room/input is the folder of the photos itself; pass its parent folder as -s: .*room$"),
        ("-s {}/nowhere", None, r"no folder .*nowhere; make it, put the photos into a folder input"),
        ("-s '{}'", None, r"contains quotes: '.*room'; pass /.*room, quoted only once for the shell"),
        ("-s {}", _trained, r"room is a model that train.py wrote; pass the folder of its photos as -s"),
        ("-s {}", _converted, r"no folder input in .*room, which is a scene already: train.py takes it as it is"),
        ("-s {}/input/photo_00.png", None, r"photo_00.png is a file; pass the folder that contains"),
        ("-s {} --camera PINHOLEY", None, r"--camera PINHOLEY is not a supported lens model.*OPENCV_FISHEYE"),
        (
            "-s {} --camera EQUIRECTANGULAR --lenses undistort",
            None,
            r"no pinhole image shows a panorama; omit --lenses",
        ),
        ("-s {} --poses no", None, r"no poses in no; pass a transforms.json, or the folder of cameras.txt"),
        ("-s {} --poses x --mapper global", None, r"--mapper does not go with --poses, which gives poses and lenses"),
        ("-s {} --mask_path no", None, r"no folder of masks 'no'; pass an existing folder"),
        ("-s {} --mask_path {}", None, r"none of 3 photos has a mask .*photo_00.png.png"),
        ("-s {} --max_num_features 0", None, r"--max_num_features must be at least 100, got 0"),
        ("-s {} --skip_matching", None, r"--skip_matching needs a COLMAP model in .*distorted/sparse"),
        ("-s {} --colmap_executable /no/colmap", None, r"cannot run --colmap_executable /no/colmap"),
    ],
)
def test_slips_get_one_sentence(tmp_path, words, change, said):
    scene = tmp_path / "room"
    (scene / "input").mkdir(parents=True)
    for number in range(3):
        Image.new("RGB", (40, 30)).save(scene / "input" / f"photo_{number:02d}.png")
    if change:
        change(scene)
    with pytest.raises(UserError, match=said) as error:
        convert.main([word.replace("{}", str(scene)) for word in words.split()])
    assert "\n" not in str(error.value)
    assert not (scene / "sparse").exists()


def test_stages_are_redone_from_the_first_that_changed(tmp_path):
    def run(fail: str = "", **made_from: int) -> list[str]:
        done: list[str] = []

        def work(name: str) -> None:
            done.append(name)
            if name == fail:
                raise KeyboardInterrupt

        stages = [
            Stage(name, value, partial(done.append, f"-{name}"), partial(work, name), resumable=name == "b")
            for name, value in made_from.items()
        ]
        try:
            kept = StageRecord(tmp_path / "stages.json").run(stages)
            return [*(f"={name}" for name in kept), *done]
        except KeyboardInterrupt:
            return [*done, "stopped"]

    assert run(a=1, b=1, c=1) == ["-c", "-b", "-a", "a", "-c", "-b", "b", "-c", "c"]
    assert run(a=1, b=1, c=1) == ["=a", "=b", "=c"]
    assert run(a=1, b=2, c=1, fail="b") == ["-c", "-b", "b", "stopped"]
    # b is resumable, so it is not reset; c was never begun.
    assert run(a=1, b=2, c=1, fail="c") == ["-c", "b", "-c", "c", "stopped"]
    assert run(a=1, b=2, c=1) == ["=a", "=b", "-c", "c"]
    assert run(a=2, b=2, c=1)[:4] == ["-c", "-b", "-a", "a"]
    (tmp_path / "stages.json").write_text("[]")
    with pytest.raises(UserError, match="stages.json is damaged; remove the folder"):
        run(a=1)


@pytest.mark.slow
def test_a_finished_scene_stays_until_the_next_one_is_there(copy, monkeypatch):
    def scene() -> dict:
        own = ("input", "distorted")
        return {name: state for name, state in folder_state(copy).items() if Path(name).parts[0] not in own}

    def refused(said: str, *options: str) -> None:
        with pytest.raises(UserError, match=said):
            convert.main(["-s", str(copy), "--no_gpu", *options])
        assert scene() == before

    def fail(*_: object) -> None:
        raise UserError("no model")

    before, work = scene(), folder_state(copy / "distorted")
    assert {"images", "images_2", "sparse"} <= {Path(name).parts[0] for name in before}
    (copy / "input" / "new.png").write_bytes(b"no picture")
    refused("cannot read .*new.png")
    (copy / "input" / "new.png").unlink()
    refused("none of 8 photos has a mask", "--mask_path", str(copy.parent))
    assert folder_state(copy / "distorted") == work
    # A later failure keeps the scene too, and the record still knows that convert.py made it.
    for owner, name in ((Pycolmap, "mapping"), (report, "refuse_nothing")):
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, fail)
            refused("no model", "--mapper", "global")
    convert.main(["-s", str(copy), "--no_gpu"])
    assert scene() and not list(copy.glob("images_*"))


def test_looks_into_the_database(copy):
    database = Layout(copy).database
    features, matched = colmap.count_rows(database, "keypoints"), colmap.partners(database)
    assert colmap.count_rows(database, "matches") == VIEWS * (VIEWS - 1) // 2
    assert set(matched) == set(NAMES) and all(count >= 2 for count in matched.values())
    assert 500 < colmap.most_features(database) < 8192
    colmap.forget_matches(database)
    assert [colmap.count_rows(database, table) for table in ("matches", "keypoints")] == [0, features]
    assert set(colmap.partners(database).values()) == {0}


def test_ctrl_c_ends_the_program_that_works(tmp_path):
    script = "import os, sys, time; open(sys.argv[1], 'w').write(str(os.getpid())); time.sleep(600)"
    told = tmp_path / "pid"

    def interrupt() -> None:
        try:
            wait_for(lambda: told.is_file() and told.read_text())
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    with pytest.raises(KeyboardInterrupt):
        run_programs(tmp_path / "log", [[sys.executable, "-c", script, str(told)]], "Waiting", 1, lambda: 0)
    with pytest.raises(ProcessLookupError):
        os.kill(int(told.read_text()), 0)


def _killed_while(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str, *words: str) -> Path:
    """Call run_programs with a script in a process that is killed once the script has written to the log; the log."""
    code = (
        "import sys; from pathlib import Path; from splatting.sfm.programs import run_programs; "
        "run_programs(Path(sys.argv[1]), [sys.argv[2:]], 'Waiting', 1, lambda: 0)"
    )
    log, python = tmp_path / "log", [sys.executable, "-c"]
    command = [*python, code, str(log), *python, script, *words]
    caller = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL)
    wait_for(lambda: log.is_file() and log.read_text().endswith("\n"))
    monkeypatch.setattr(programs, "_ORPHAN_PATIENCE", 0.0)
    with pytest.raises(UserError, match="another convert.py, or a program that a killed one had started, still works"):
        refuse_while_working(log)
    caller.kill()
    caller.wait()
    return log


def test_a_killed_caller_leaves_no_worker(tmp_path, monkeypatch):
    (tmp_path / "job.json").write_text('{"step": "wait"}')
    script = (
        "import sys, time; sys.path.insert(0, 'splatting/sfm'); import worker; "
        "worker.STEPS['wait'] = lambda job: (print('at work', flush=True), time.sleep(600)); "
        "worker.main(sys.argv[1])"
    )
    log = _killed_while(tmp_path, monkeypatch, script, str(tmp_path / "job.json"))
    # The lock tells whether the worker ended. Its process id does not, as there may be no process to reap it.
    monkeypatch.setattr(programs, "_ORPHAN_PATIENCE", LIMIT)
    refuse_while_working(log)


def test_programs_that_outlive_a_killed_caller_are_waited_for(tmp_path, monkeypatch):
    script = "import os, time; print(os.getpid(), flush=True); time.sleep(600)"
    log = _killed_while(tmp_path, monkeypatch, script)
    try:
        for run in (refuse_while_working, lambda log: run_programs(log, [["true"]], "Next", 1, lambda: 0)):
            with pytest.raises(UserError, match="still works in .*; wait for it or end it"):
                run(log)
    finally:
        os.kill(int(log.read_text()), signal.SIGKILL)
    monkeypatch.setattr(programs, "_ORPHAN_PATIENCE", LIMIT)
    refuse_while_working(log)


def test_a_program_that_fails_is_quoted(tmp_path):
    script = "import sys; print('first'); print('no disk left'); sys.exit(3)"
    with pytest.raises(UserError, match=r"features failed \(status 3: no disk left\); all output is in .*log"):
        run_programs(tmp_path / "log", [[sys.executable, "-c", script]], "Features", 1, lambda: 0)
    with pytest.raises(UserError, match="cannot run /no/program"):
        run_programs(tmp_path / "log", [["/no/program"]], "Features", 1, lambda: 0)


def _fake_colmap(folder: Path, prefix: str, without: str = "") -> str:
    """A program that answers like COLMAP; its GPU options are <prefix>Extraction.use_gpu, <prefix>Matching.use_gpu."""
    path = folder / "colmap"
    path.write_text(
        f'#!/bin/sh\ncase "$1" in\n{without or "none"}) exit 1;;\nhelp) echo "COLMAP 9.9";;\n'
        f"feature_extractor) echo '  --{prefix}Extraction.use_gpu arg (=1)';;\n"
        f"*_matcher) echo '  --{prefix}Matching.use_gpu arg (=1)';;\nesac\n"
    )
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


@pytest.mark.parametrize("prefix", ["Sift", "Feature"])
def test_gpu_options_have_the_names_of_the_colmap_that_is_there(tmp_path, prefix):
    layout = Layout(tmp_path / "scene")
    program = Program(_fake_colmap(tmp_path, prefix), layout, SETTINGS)
    assert program.identity == "COLMAP 9.9"
    (first, second) = program.features([["a b.png"], ["c.png", "d.png"]], masks=True)
    assert first[-2:] == second[-2:] == [f"--{prefix}Extraction.use_gpu", "0"]
    assert Path(second[second.index("--image_list_path") + 1]).read_text() == "c.png\nd.png\n"
    assert first[first.index("--ImageReader.mask_path") + 1] == str(layout.masks)
    assert "--ImageReader.single_camera" in first
    (each,) = program.features([["a b.png"], ["c.png"]], masks=False)
    assert "--ImageReader.single_camera_per_image" in each and "--ImageReader.single_camera" not in each
    assert Path(each[each.index("--image_list_path") + 1]).read_text() == "a b.png\nc.png\n"
    ((_, *match),) = program.matching()
    database = ["--database_path", str(layout.database)]
    assert match == ["exhaustive_matcher", *database, f"--{prefix}Matching.use_gpu", "0"]
    (mapper,) = program.mapping("incremental", layout.models)
    assert mapper[1] == "mapper" and mapper[-2:] == ["--Mapper.ba_global_function_tolerance", "1e-06"]


def test_programs_that_can_not_do_it(tmp_path):
    layout, whole = Layout(tmp_path / "scene"), replace(SETTINGS, mapper="global")
    with pytest.raises(UserError, match="help` as COLMAP does"):
        Program("/bin/true", layout, SETTINGS)
    with pytest.raises(UserError, match="lists neither --FeatureExtraction.use_gpu nor --SiftExtraction.use_gpu"):
        Program(_fake_colmap(tmp_path, "New"), layout, SETTINGS)
    program = Program(_fake_colmap(tmp_path, "Sift"), layout, whole)
    ((calibrate,), (mapper,)) = program.calibration(), program.mapping("global", layout.models)
    assert [calibrate[1], mapper[1]] == ["view_graph_calibrator", "global_mapper"]
    assert calibrate[3] == mapper[3] == str(layout.calibrated)
    old = _fake_colmap(tmp_path, "Sift", without="global_mapper")
    assert Program(old, layout, replace(SETTINGS, mapper="auto")).ways == ("incremental",)
    with pytest.raises(UserError, match="COLMAP 9.9.*has no global_mapper; use --mapper incremental"):
        Program(old, layout, whole)


def test_orientation_is_baked_in_and_other_exif_kept(converted):
    turned = converted / "input" / "photo_07.jpg"
    with Image.open(turned) as stored, Image.open(converted / "distorted" / "photos" / "photo_07.jpg") as upright:
        assert stored.size == SIZE[::-1] and upright.size == SIZE
        assert upright.getexif().get(0x0112, 1) == 1 and upright.getexif()[0x010F] == "maker"
        straight = np.asarray(stored.transpose(Image.Transpose.ROTATE_270), dtype=float)
        # A second JPEG compression of quality 95 changes a few levels.
        assert np.abs(np.asarray(upright, dtype=float) - straight).mean() < 4
    plain = "distorted/photos/photo_00.png"
    assert (converted / plain).read_bytes() == (converted / "input" / "photo_00.png").read_bytes()


def test_webp_is_rewritten_since_colmap_does_not_read_it(tmp_path):
    layout = Layout(tmp_path)
    layout.input.mkdir()
    Image.effect_noise((40, 30), 60).convert("RGB").save(layout.input / "a.webp", lossless=True)
    prepare_images(layout, ["a.webp"], None)
    with Image.open(layout.input / "a.webp") as before, Image.open(layout.prepared / "a.webp.png") as after:
        np.testing.assert_array_equal(np.asarray(before), np.asarray(after))


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


def test_every_lens_model_can_be_asked_for():
    assert {*LENS_MODELS, "INVALID"} == set(pycolmap.CameraModelId.__members__)


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
    make_photos(tmp_path / "input", VIEWS, lens=FISHEYE)
    shots = sorted((tmp_path / "input").iterdir())
    words = ["-s", str(tmp_path), "--no_gpu", "--camera", FISHEYE.model]

    def converted(*options: str) -> tuple[str, list]:
        convert.main([*words, *options])
        report = json.loads((tmp_path / "convert_report.json").read_text())
        return report["lenses"], read_scene(tmp_path, "images", hold_out=False, native=True).train_cameras

    lenses, views = converted()
    assert lenses == "native" and "the photos as they are, with the cameras that were fitted (OPENCV_FISHEYE)" in (
        capsys.readouterr().out
    )
    assert [path.read_bytes() for path in shots] == [view.image_path.read_bytes() for view in views]
    # The photos tell no focal length, and where the fit begins is 6 % off.
    assert all(view.native.focal == pytest.approx(FISHEYE.params[:2], rel=0.01) for view in views)
    _check_places(pycolmap.Reconstruction(tmp_path / "sparse" / "0"), [path.name for path in shots], FISHEYE.model)
    lenses, views = converted("--lenses", "undistort")
    out = capsys.readouterr().out
    assert "reused from an earlier run: photos, features, matching, mapping;" in out
    assert "undistorted photos, with pinhole" in out
    assert lenses == "undistort" and all(view.native is None for view in views)
    assert shots[0].read_bytes() != views[0].image_path.read_bytes()


def test_cameras_beside_poses_have_no_effect(tmp_path, capsys):
    for words, said in (([], False), (["--cameras", "shared"], True)):
        with pytest.raises(UserError, match="no folder input"):
            convert.main(["-s", str(tmp_path), "--poses", "transforms.json", *words])
        assert ("warning: --cameras has no effect beside --poses" in capsys.readouterr().err) == said


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


@pytest.mark.slow
def test_points_are_computed_at_given_poses(tmp_path, capsys):
    make_photos(tmp_path / "input", VIEWS + 1)
    poses, names = _given(tmp_path / "phone", VIEWS + 1), [f"photo_{k:02d}.png" for k in range(VIEWS)]
    content = json.loads(poses.read_text())
    content["frames"] = [*content["frames"][:-1], {**content["frames"][0], "file_path": "images/gone.png"}]
    poses.write_text(json.dumps(content))
    words = ["-s", str(tmp_path), "--no_gpu", "--poses"]
    convert.main([*words, str(poses)])
    out, err = capsys.readouterr()
    assert "1 poses of" in err and "1 of 9 photos have no pose in the file and were left out (photo_08.png)" in err
    assert f"{VIEWS} of 9 photos placed" in out

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
    # The same poses as a text model without points, which other programs write.
    model = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    model.delete_all_points2D_and_points3D()
    (tmp_path / "model").mkdir()
    model.write_text(str(tmp_path / "model"))
    (tmp_path / "model" / "points3D.txt").unlink()
    convert.main([*words, str(tmp_path / "model")])
    judge()
    # Axes of another convention: no pose is where the photo shows it to be.
    for frame in content["frames"]:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) * (1, -1, -1, 1)).tolist()
    poses.write_text(json.dumps(content))
    before = folder_state(tmp_path / "sparse")
    with pytest.raises(UserError, match=r"the photos do not fit the given poses \(\d points.*or omit --poses"):
        convert.main([*words, str(poses)])
    assert folder_state(tmp_path / "sparse") == before


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda text: text.replace('"w": 480', '"w": 360'), "photo_00.png has 240 x 180 pixels .* 360 x 360; use the"),
        (
            lambda text: text.replace("photo_0", "frame_"),
            "0 photos of .*input have a pose in .*lists ./images/frame",
        ),
        (
            lambda text: text.replace("photo_01", "left/photo_02"),
            "photo_02 and .*photo_02 in .* of the photo photo_02",
        ),
        (lambda text: text.replace("transform_matrix", "pose"), "frame 1 .* has no transform_matrix"),
    ],
)
def test_poses_that_can_not_be_used(tmp_path, change, said):
    make_photos(tmp_path / "input", 3)
    poses = _given(tmp_path, 3)
    poses.write_text(change(poses.read_text()))
    with pytest.raises(UserError, match=said):
        convert.main(["-s", str(tmp_path), "--poses", str(poses)])


def test_which_photos_stay_as_they_are():
    stay = {model.removesuffix("_FISHEYE") for model in LENS_MODELS if colmap.is_native("auto", {"OPENCV", model})}
    assert stay == {"EQUIRECTANGULAR", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "THIN_PRISM"}
    assert colmap.is_native("native", {"OPENCV"}) and not colmap.is_native("undistort", {"OPENCV_FISHEYE"})


@pytest.mark.parametrize("mask", ["a.jpg.png", "a.jpg", "a.png"])
def test_masks_have_the_names_of_their_photos(tmp_path, mask):
    (tmp_path / mask).touch()
    assert find_masks(["a.jpg", "b.jpg"], tmp_path, tmp_path / "input") == {"a.jpg": tmp_path / mask}


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
    with pytest.raises(UserError, match=r"cannot read .*b.jpg \(.*, or pass --skip_unreadable to go on without"):
        check_images(layout, names, masks)
    (layout.input / "c.jpg").write_bytes(b"<html>")
    Image.new("L", (40, 30)).save(masks / "e.jpg.png")
    said = "^3 of 5 photos cannot be used: .*b.jpg.*c.jpg.*mask .*e.jpg.png has 40 x 30 pixels, but its photo e.jpg has"
    said += ".*; replace or remove them, or pass --skip_unreadable to go on without photos that cannot be read$"
    with pytest.raises(UserError, match=said) as error:
        check_images(layout, names, masks)
    assert "\n" not in str(error.value) and "a.jpg" not in str(error.value) and "d.jpg" not in str(error.value)


def _model(registered: int, points: int = 5000, track: float = 5.0, error: float = 0.5, first: int = 0) -> report.Model:
    return report.Model("0", [f"{i:03d}" for i in range(first, first + registered)], points, track, error, [])


def test_poses_that_no_pair_judged_are_not_called_right():
    photos = [f"{i:03d}" for i in range(40)]
    words = [_model(40)], photos, dict.fromkeys(photos, 3), "auto", 0
    (line,) = map(str, of_model(*words, tried=[{"way": "global", "photos": 40, "pairs": 0}]))
    assert line.startswith("the poses could not be judged")
    judged = {"way": "global", "photos": 40, "pairs": 90, "agreeing": 40, "contradicting": 0.02}
    assert [*of_model(*words, tried=[judged])] == []


@pytest.mark.parametrize(
    ("models", "said"),
    [
        ([_model(40)], []),
        (
            [_model(38)],
            [r"2 of 40 photos left out \(038, 039\), 1 of them without a match .*something else; --matcher"],
        ),
        (
            [_model(25), _model(15, first=25)],
            ["15 of 40", r"form 2 unconnected parts \(25 photos are used, the other parts have 15\)"],
        ),
        ([_model(40), _model(12)], []),
        ([_model(40, points=900)], ["only 900 points; .*1000; use larger .* photos, or --max_num_features 16384$"]),
        ([_model(40, track=2.4)], ["in 2.4 photos on average, so the photos overlap little"]),
        ([_model(40, error=2.0)], ["mean reprojection error is 2.0 pixels"]),
    ],
)
def test_advice(models, said):
    photos = [f"{i:03d}" for i in range(40)]
    lines = [*map(str, of_model(models, photos, dict.fromkeys(photos[:39], 3), "sequential", 8192))]
    assert [bool(re.search(expected, line)) for line, expected in zip(lines, said, strict=True)] == [True] * len(said)
