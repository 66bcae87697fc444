"""render.py --path: the video, its frames, its memory, and every refusal."""

import json
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gaussians import model, pipeline
from PIL import Image

from applications.viewer.untrained import _make_spheres
from gaussian_renderer.camera_paths import from_above, render_path, video
from gaussian_renderer.camera_paths.keyframes import CameraPath, Keyframe
from gaussian_renderer.camera_paths.without_scene import WithoutScene, circle_cameras
from scene.cameras import camera_to_JSON
from scene.dataset_readers import read_scene
from scene.with_splats import model_of
from utils.system_utils import UserError

imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="no imageio-ffmpeg: pip install '.[video]'")
render = pytest.importorskip("render", reason="the extensions are not built: make test")
PATH = CameraPath(tuple(Keyframe(at, (0.2 * at, 0.0, -3.0), (1.0, 0.0, 0.0, 0.0), 45.0 + at) for at in (0.0, 0.4, 1.0)))


def decoded(path: Path) -> tuple[dict, list[np.ndarray]]:
    """Return ffmpeg's facts about a video, and the frames."""
    # ffmpeg's default conversion rounds down, and makes every image a level darker.
    exact = ["-vf", "scale=flags=bicubic+accurate_rnd+full_chroma_int+full_chroma_inp,format=rgb24"]
    frames = imageio_ffmpeg.read_frames(str(path), output_params=exact)
    known = next(frames)
    width, height = known["size"]
    return known, [np.frombuffer(data, np.uint8).reshape(height, width, 3) for data in frames]


@pytest.fixture
def out(tmp_path: Path, _colmap_master: Path) -> Path:
    """A model folder with 60 Gaussians."""
    folder = tmp_path / "model"
    model(60, seed=3).save_ply(str(folder / "point_cloud" / "iteration_7" / "point_cloud.ply"))
    (folder / "cfg_args").write_text(f"Namespace(sh_degree=3, source_path={str(_colmap_master)!r}, eval=True)")
    return folder


@pytest.fixture
def run(out: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Runs render.py in this process; returns the folder of the videos."""

    def command(*words: object) -> Path:
        monkeypatch.setattr("sys.argv", ["render.py", "-m", str(out), *map(str, words)])
        render.main()
        return out / "videos" / "ours_7"

    return command


def read(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    return 10 * np.log10(255**2 / np.mean((one.astype(float) - other) ** 2))


def written(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def patches(count: int, width: int = 64, height: int = 48) -> Iterator[np.ndarray]:
    """Frames of 16 x 16 pixels of one colour each."""
    rng = np.random.default_rng(0)
    for _ in range(count):
        colours = rng.integers(0, 256, (height // 16, width // 16, 3), np.uint8)
        yield colours.repeat(16, axis=0).repeat(16, axis=1)


# What is written


def test_the_video_of_a_file_shows_its_frames(run, tmp_path, capsys):
    PATH.write(tmp_path / "my tour.json")
    folder = run("--path", tmp_path / "my tour.json", "--fps", 20, "--frames")
    names = [f"my tour/{n:05d}.png" for n in range(21)]
    assert written(folder) == ["my tour.mp4", *names]
    known, frames = decoded(folder / "my tour.mp4")
    assert (known["fps"], known["size"], known["duration"]) == (20, (96, 64), 1.05)
    assert known["codec"] == "h264" and known["pix_fmt"] == "yuv420p(tv, bt709, progressive)"
    assert len(frames) == 21
    scores = [psnr(frame, read(folder / name)) for frame, name in zip(frames, names, strict=True)]
    assert min(scores) >= 35, scores
    assert "my tour.mp4: 21 frames of 96 x 64, 1.05 s, " in capsys.readouterr().out
    assert not any((folder.parents[1] / name).exists() for name in ("train", "test"))


@pytest.mark.parametrize(("name", "size", "count"), [("interpolate", None, 6), ("ellipse", (50, 34), 5)])
def test_each_generated_path_has_its_name_size_and_length(run, name, size, count):
    folder = run("--path", name, "--seconds", "0.5", "--fps", "10", *(["--size", *size] if size else []))
    known, frames = decoded(folder / f"{name}.mp4")
    assert known["size"] == (size or (96, 64)) and len(frames) == count
    assert np.std(frames[0]) > 5 and written(folder) == [f"{name}.mp4"]  # something is seen
    for odd, even in (((97, 64), (96, 64)), ((96, 65), (96, 64)), ((1, 1), (2, 2))):
        assert render_path.even_size(SimpleNamespace(image_width=odd[0], image_height=odd[1])) == even


def test_a_video_needs_no_photos(run, out, tmp_path, capsys, _colmap_master):
    """A folder's recorded cameras make the same video where the scene is gone; views are refused."""
    PATH.write(tmp_path / "tour.json")
    options = (out / "cfg_args").read_text().replace("eval=True", "eval=False, resolution=2")
    infos = read_scene(str(_colmap_master), "images", False).train_cameras
    (out / "cameras.json").write_text(json.dumps([camera_to_JSON(n, camera) for n, camera in enumerate(infos)]))
    for path, seconds in (("interpolate", ["--seconds", 1]), ("ellipse", ["--seconds", 1]), ("tour.json", [])):
        found = []
        for source in (str(_colmap_master), f"{tmp_path}/gone"):
            (out / "cfg_args").write_text(options.replace(str(_colmap_master), source))
            path = path if seconds else tmp_path / path
            found.append(decoded(run("--path", path, "--fps", 4, *seconds) / f"{Path(path).stem}.mp4"))
        (known, frames), (again, of_gone) = found
        assert known["size"] == again["size"] == (48, 32) and len(frames) == len(of_gone) >= 4
        assert max(np.abs(one.astype(int) - other).mean() for one, other in zip(of_gone, frames, strict=True)) < 1
        assert capsys.readouterr().err.count("gone is gone, so there are poses, but no photos") == 1
    with pytest.raises(UserError, match="no scene folder .*gone; name an existing one with -s"):
        run()


def test_the_background_is_the_models_and_exposures_are_not_applied(run, out, tmp_path, _colmap_master):
    CameraPath(tuple(Keyframe(at, (0, 0, 90 + at), (1, 0, 0, 0), 40) for at in (0, 1))).write(tmp_path / "away.json")
    images = _colmap_master / "images"
    names = [path.relative_to(images).as_posix() for path in images.rglob("*.png")]
    inverted = [[-1, 0, 0, 1], [0, -1, 0, 1], [0, 0, -1, 1]]
    (out / "exposure.json").write_text(json.dumps(dict.fromkeys(names, inverted)))
    options = (out / "cfg_args").read_text()
    for white, trained in ((False, False), (True, False), (True, True)):
        (out / "cfg_args").write_text(options.replace(")", f", white_background={white}, train_test_exp={trained})"))
        folder = run("--path", tmp_path / "away.json", "--fps", 1, "--frames")
        assert (read(folder / "away" / "00000.png") == 255 * white).all()


def test_frames_of_an_earlier_run_are_removed_and_nothing_else(run, tmp_path):
    PATH.write(tmp_path / "a.json")
    folder = run("--path", tmp_path / "a.json", "--fps", 5, "--frames")
    (folder / "a" / "notes.png").write_text("mine")
    run("--path", tmp_path / "a.json", "--fps", 2, "--frames")
    assert written(folder) == ["a.mp4", "a/00000.png", "a/00001.png", "a/00002.png", "a/notes.png"]
    run("--path", tmp_path / "a.json", "--fps", 2)
    assert written(folder) == ["a.mp4", "a/notes.png"]


def test_the_next_frames_are_drawn_while_the_encoder_is_busy(run, monkeypatch):
    drawn, ahead, draw = [], threading.Event(), render_path.render

    def counted(*given, **options):
        drawn.append(0)
        if len(drawn) == 4:
            ahead.set()
        return draw(*given, **options)

    def encode(path: Path, frames: Iterator[np.ndarray], *_: int) -> None:
        next(frames)
        assert ahead.wait(60) and len(list(frames)) == 9
        path.parent.mkdir(parents=True)
        path.touch()

    for name, change in (("render", counted), ("write_video", encode), ("pictures_at_once", lambda _: 2)):
        monkeypatch.setattr(render_path, name, change)
    run("--path", "ellipse", "--seconds", 1, "--fps", 10)


@pytest.mark.parametrize("frames", [["--frames"], []], ids=["with frames", "without"])
def test_an_interrupted_video_leaves_the_earlier_one_and_its_frames(run, out, tmp_path, monkeypatch, frames):
    PATH.write(tmp_path / "a.json")
    folder = run("--path", tmp_path / "a.json", "--fps", 5, "--frames")
    before = {name: (folder / name).read_bytes() for name in written(folder)}
    (folder / ".a.tmp").mkdir()
    (folder / ".a.tmp" / "00099.png").touch()  # of a killed run
    drawn, draw = [], render_path.render

    def interrupted(*given, **options):
        if len(drawn) == 40:  # of 51, beyond the first ones that are written at once
            raise KeyboardInterrupt
        return drawn.append(0) or draw(*given, **options)

    monkeypatch.setattr(render_path, "render", interrupted)
    words = ["--path", tmp_path / "a.json", "--fps", 50, *frames]
    with pytest.raises(KeyboardInterrupt):
        run(*words, "--size", 64, 48)
    assert {name: (folder / name).read_bytes() for name in written(folder)} == before
    assert sorted(path.name for path in folder.iterdir()) == ["a", "a.mp4"]
    drawn[:] = [0] * 100
    (folder / "a" / "notes.png").write_text("mine")  # so that the folder can not be renamed
    run(*words, "--size", 64, 48)
    names = [f"a/{number:05d}.png" for number in range(51 if frames else 0)]
    assert written(folder) == ["a.mp4", *names, "a/notes.png"]
    assert {read(folder / name).shape for name in names} <= {(48, 64, 3)}


# What is refused


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("--fps 5", "^--fps works only with --path; leave it out, or pass --path, too$"),
        ("--path ellipse --depth", "^--depth works only without --path; leave it out, or --path$"),
        ("--path ellipse --fps 241", "^--fps must be 1 to 240, got 241$"),
        ("--path ellipse --size 401 300", "odd side.* use --size 400 300$"),
        ("--path ellipse --size 0 4", "^--size must be two even numbers of 2 to 16384 pixels, got 0 4$"),
        ("--path ellipse --seconds nan", "^--seconds must be 0.1 to 3600, got nan$"),
        ("--path elipse", "^--path must be interpolate, ellipse, spiral, top or a file of keyframes; there is no file"),
        ("--path " + "x" * 5000, "^--path must be .*there is no file xxx"),
        ("--path spiral", "^--path spiral needs training cameras that face one way"),
        ("--path broken.json", "broken.json is not JSON"),
        ("--path good.json --seconds 3", "^--seconds works with interpolate, ellipse, spiral only; .* has its own"),
        ("--path 4000.json", "lasts 4000 s, and a path lasts 0.1 to 3600; give the keyframes'"),
        ("--path 5e-324.json", "lasts 4.94066e-324 s, and a path lasts 0.1 to 3600; give the keyframes'"),
    ],
    ids=lambda value: value[:40],
)
def test_a_wrong_option_or_file_is_refused(run, out, tmp_path, monkeypatch, words, sentence):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "broken.json").write_text("{")
    for name, seconds in (("good", 1.0), ("4000", 4000.0), ("5e-324", 5e-324)):
        keyframes = PATH.keyframes[0], replace(PATH.keyframes[-1], seconds=seconds)
        CameraPath(keyframes).write(tmp_path / f"{name}.json")
    before = written(out)
    with pytest.raises(UserError, match=sentence) as refused:
        run(*words.split())
    assert "\n" not in str(refused.value) and written(out) == before


def test_a_missing_ffmpeg_is_said_before_the_model_is_read(run, out, tmp_path, monkeypatch):
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(tmp_path / "none"))
    with pytest.raises(UserError, match=r"^cannot start .*none \(No such file or directory\); `pip install "):
        run("--path", "ellipse")
    shutil.rmtree(out / "point_cloud")
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: (_ for _ in ()).throw(RuntimeError("No ffmpeg exe")))
    with pytest.raises(UserError, match="has no ffmpeg program for this machine; install ffmpeg, and name it in"):
        run("--path", "ellipse")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(UserError, match=r"videos need the package imageio-ffmpeg; `pip install '\.\[video\]'`"):
        run("--path", "ellipse")


FULL = "echo '[out#0/mp4 @ 0x5603] Error muxing' >&2; echo '[out#0/mp4 @ 0x5603] No space left on device' >&2"


@pytest.mark.parametrize(
    ("script", "reason"),
    [
        (f"head -c 300000 > /dev/null; {FULL}; exit 228", "No space left on device"),
        (f"cat > /dev/null; {FULL}; exit 228", "No space left on device"),  # when all frames are written
        ("head -c 300000 > /dev/null; kill -9 $$", "it ended with -9"),
    ],
    ids=["in the middle", "at the end", "killed"],
)
def test_an_ffmpeg_that_dies_is_quoted_and_no_file_stays(run, out, tmp_path, monkeypatch, script, reason):
    program = tmp_path / "ffmpeg"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))
    with pytest.raises(UserError, match="^ffmpeg could not write .*ellipse.mp4, after [0-9]+ frames ") as refused:
        run("--path", "ellipse", "--seconds", 1)
    assert f"({reason}); free space there, or choose another --size or place" in str(refused.value)
    assert written(out / "videos") == []


def test_an_interrupted_video_leaves_nothing(tmp_path, monkeypatch):
    started: list[subprocess.Popen] = []
    begin = {"Popen": lambda *a, **k: started.append(subprocess.Popen(*a, **k)) or started[-1]}
    monkeypatch.setattr(video, "subprocess", SimpleNamespace(**vars(subprocess) | begin))

    def frames() -> Iterator[np.ndarray]:
        yield from patches(3)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        video.write_video(tmp_path / "a.mp4", frames(), 64, 48, 30)
    assert started[0].returncode is not None and list(tmp_path.iterdir()) == []


def test_a_picture_from_above_is_to_scale_whatever_the_height_and_without_what_no_camera_is_above(tmp_path, capsys):
    places = np.float32([[-1, 0.9, -1], [1, -0.3, -0.5], [0.3, 0.5, 1], [0, -40, 0]])
    gaussians = model_of(_make_spheres(places, np.float32([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]), 0.05))
    scene = WithoutScene(gaussians, str(tmp_path), 7, circle_cameras(places[:3]))
    background, pipe = torch.zeros(3), pipeline()
    path = from_above.render_top(scene, "", pipe, background, (400, 300))
    said = capsys.readouterr().out
    assert said.startswith(f"{path}: 400 x 300, a pixel is ") and said.endswith(" of the scene's units\n")
    image = read(path).astype(float)
    assert image.shape == (300, 400, 3) and image.min(2).max() < 10  # nothing is white
    centers = []
    for channel in range(3):
        rows, columns = (image[..., channel] * (image[..., channel] > 50)).nonzero()
        centers.append((columns.mean(), rows.mean()))
    seen = np.array(centers) * float(said.split()[-5])
    true = places[:3, [0, 2]] * [1, -1]  # the first camera looks along z, which is up in the picture
    np.testing.assert_allclose(seen - seen[0], true - true[0], atol=0.02)
    record = {"rotation": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], "scale": 2.0, "translation": [0, 0, 0], "unit": "metre"}
    (tmp_path / "model.json").write_text(json.dumps({"similarity": record}))
    from_above.render_top(scene, "", pipe, background, None)
    assert capsys.readouterr().out.endswith(" m\n")
    turned = read(path)
    rows, columns = (turned[..., 0] > 100).nonzero()
    assert columns.mean() < 0.5 * turned.shape[1] and rows.mean() < 0.5 * turned.shape[0]  # x is -1, and so is z


@pytest.mark.parametrize("words", ["--fps 10", "--seconds 3", "--frames"])
def test_a_picture_from_above_has_no_options_of_videos(run, words):
    with pytest.raises(UserError, match=f"is one picture, without {words.split()[0]}"):
        run("--path", "top", *words.split())
    assert (run("--path", "top", "--size", 64, 48) / "top.png").is_file()
