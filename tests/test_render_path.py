"""render.py --path: the video, its frames, its memory, and every refusal."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gaussians import model, pipeline
from PIL import Image
from synthetic import options_of

from gaussian_renderer import render as draw
from gaussian_renderer.free_view import free_view
from splatting.camera_paths import render_path, video
from splatting.camera_paths.keyframes import CameraPath, Keyframe
from splatting.camera_paths.poses import poses_of
from splatting.camera_paths.video import write_video
from utils.system_utils import UserError

imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="no imageio-ffmpeg: pip install '.[video]'")
render = pytest.importorskip("render", reason="the extensions are not built: make test")
PATH = CameraPath(tuple(Keyframe(at, (0.2 * at, 0.0, -3.0), (1.0, 0.0, 0.0, 0.0), 45.0 + at) for at in (0.0, 0.4, 1.0)))


def decoded(path: Path) -> tuple[dict, list[np.ndarray]]:
    """What ffmpeg knows of a video, and its frames."""
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


def test_a_second_decoder_sees_neither_levels_nor_colours_shifted(tmp_path, monkeypatch):
    """H.264 has a value of colour on the left one of two pixels, in the middle of two rows (its figure 6-1)."""
    av = pytest.importorskip("av", reason="PyAV, a second decoder, is not installed")
    monkeypatch.setattr(video, "CRF", 1)
    columns, rows = np.meshgrid(np.arange(96), np.arange(64))
    given = np.stack([2 * columns, 40 + 0 * rows, 3 * rows], axis=-1).astype(np.uint8)
    write_video(tmp_path / "a.mp4", [given] * 12, 96, 64, 24)
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.average_rate, stream.frames, stream.duration * stream.time_base) == (24, 12, 0.5)
        code = stream.codec_context
        assert (code.name, code.pix_fmt) == ("h264", "yuv420p")
        # Of ITU-T H.273: limited range, and BT.709 thrice.
        assert (code.color_range, code.colorspace, code.color_primaries, code.color_trc) == (1, 1, 1, 1)
        frames = list(container.decode(stream))
    assert [frame.pts * stream.time_base * 24 for frame in frames] == list(range(12))
    planes, share = frames[0].to_ndarray(format="yuv420p").astype(float), given / 255
    luma = share @ [0.2126, 0.7152, 0.0722]
    assert abs((planes[:64] - 16 - 219 * luma).mean()) < 0.1
    for plane, channel, factor in zip(planes[64:].reshape(2, 32, 48), (2, 0), (1.8556, 1.5748), strict=True):
        exact = 128 + 224 * (share[..., channel] - luma) / factor
        left = (exact[::2, ::2] + exact[1::2, ::2]) / 2
        assert abs((plane - left)[4:-4, 4:-4].mean()) < 0.1  # half a pixel would be 0.4


@pytest.mark.parametrize(("name", "size", "count"), [("interpolate", None, 6), ("ellipse", (50, 34), 5)])
def test_each_generated_path_has_its_name_size_and_length(run, name, size, count):
    folder = run("--path", name, "--seconds", "0.5", "--fps", "10", *(["--size", *size] if size else []))
    known, frames = decoded(folder / f"{name}.mp4")
    assert known["size"] == (size or (96, 64)) and len(frames) == count
    assert np.std(frames[0]) > 5 and written(folder) == [f"{name}.mp4"]  # something is seen
    for odd, even in (((97, 64), (96, 64)), ((96, 65), (96, 64)), ((1, 1), (2, 2))):
        assert render_path.even_size(SimpleNamespace(image_width=odd[0], image_height=odd[1])) == even


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


def test_the_lens_of_a_photo_is_ignored(run, out, _colmap_master):
    """The scene's photos have principal points off centre. A path through a camera shows it centred."""
    folder = run("--path", "interpolate", "--seconds", "0.5", "--fps", "4", "--frames")
    scene = render.load_saved(options_of(_colmap_master, out, eval=True), 7)
    first = scene.getTrainCameras()[0]
    assert abs(first.cx - first.image_width / 2) > 1
    pose = poses_of([first])
    view = free_view(96, 64, first.FoVy, pose.positions[0], pose.quaternions[0], "cpu")
    with torch.no_grad():
        image = draw(view, scene.gaussians, pipeline(), torch.zeros(3))["render"]
    shown = read(folder / "interpolate" / "00000.png").astype(float)
    assert np.abs(shown - 255 * image.permute(1, 2, 0).numpy()).max() < 1.5


def test_frames_of_an_earlier_run_are_removed_and_nothing_else(run, tmp_path):
    PATH.write(tmp_path / "a.json")
    folder = run("--path", tmp_path / "a.json", "--fps", 5, "--frames")
    (folder / "a" / "notes.png").write_text("mine")
    run("--path", tmp_path / "a.json", "--fps", 2, "--frames")
    assert written(folder) == ["a.mp4", "a/00000.png", "a/00001.png", "a/00002.png", "a/notes.png"]
    run("--path", tmp_path / "a.json", "--fps", 2)
    assert written(folder) == ["a.mp4", "a/notes.png"]


def _resident() -> int:
    """Bytes in memory of this process and of those that it started."""
    tasks = Path("/proc/self/task").glob("*/children")
    processes = ["self", *(child for task in tasks for child in task.read_text().split())]
    pages = [int(Path(f"/proc/{process}/statm").read_text().split()[1]) for process in processes]
    return sum(pages) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.slow
@pytest.mark.skipif(not list(Path("/proc/self/task").glob("*/children")), reason="/proc tells no memory of processes")
def test_memory_does_not_grow_with_the_length(run, monkeypatch):
    drawn, sizes = render_path.render, []

    def watched(*args, **kwargs):
        sizes.append(_resident() if len(sizes) in (150, 599) else 0)
        return drawn(*args, **kwargs)

    monkeypatch.setattr(render_path, "render", watched)
    folder = run("--path", "ellipse", "--seconds", 20, "--size", 160, 120)
    assert len(sizes) == 600
    assert sizes[599] - sizes[150] < 8e6  # the frames between take 26 MB
    known, frames = decoded(folder / "ellipse.mp4")
    assert len(frames) == 600 and known["duration"] == 20


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
        ("--path elipse", "^--path must be interpolate, ellipse, spiral or a file of keyframes; there is no file"),
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


def test_a_lack_of_memory_names_a_smaller_size(run, out, monkeypatch):
    monkeypatch.setattr(render_path, "render", lambda *_, **__: (_ for _ in ()).throw(MemoryError()))
    for words, size, remedy in (
        ([], "96 x 64", r"lower --resolution \(-r\), or pass a smaller --size"),
        (["--size", "64", "48"], "64 x 48", "pass a smaller --size"),
    ):
        with pytest.raises(UserError, match=rf"images of {size}\); {remedy}, or free memory that other programs use$"):
            run("--path", "ellipse", *words)
    assert written(out / "videos") == []


def test_a_video_that_cannot_be_placed_is_refused(run, out):
    (out / "videos" / "ours_7" / "ellipse.mp4").mkdir(parents=True)
    with pytest.raises(UserError, match="^cannot write .*ellipse.mp4 .Is a directory.; free space"):
        run("--path", "ellipse", "--seconds", "0.2")
    (out / "videos" / "ours_7" / "ellipse.mp4").rmdir()
    assert written(out / "videos") == []


def test_an_interrupted_video_leaves_nothing(tmp_path, monkeypatch):
    started: list[subprocess.Popen] = []
    popen = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", lambda *a, **k: (started.append(popen(*a, **k)), started[0])[1])

    def frames() -> Iterator[np.ndarray]:
        yield from patches(3)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "a.mp4", frames(), 64, 48, 30)
    assert started[0].returncode is not None and list(tmp_path.iterdir()) == []


def test_names_that_ffmpeg_would_take_for_something_else(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("-y.mp4", "a:b.mp4", "pipe:1.mp4", "%d.mp4", "ä ü.mp4"):
        write_video(Path(name), patches(2), 64, 48, 30)
        assert len(decoded(Path.cwd() / name)[1]) == 2
    assert len(list(tmp_path.iterdir())) == 5
