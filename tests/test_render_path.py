"""render.py --path: the video, its frames, its memory, and every refusal."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gaussians import model, pipeline
from PIL import Image
from waiting import LIMIT, wait_for

from moving_cameras import video
from moving_cameras.keyframes import CameraPath, Keyframe
from moving_cameras.video import video_writer
from utils.system_utils import UserError

imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="no imageio-ffmpeg: pip install '.[video]'")
render = pytest.importorskip("render", reason="the extensions are not built: make test")
ROOT = Path(__file__).resolve().parents[1]
PATH = CameraPath(tuple(Keyframe(at, (0.2 * at, 0.0, -3.0), (1.0, 0.0, 0.0, 0.0), 45.0 + at) for at in (0.0, 0.4, 1.0)))


@pytest.fixture(scope="session")
def decoder() -> Callable[[Path], tuple[dict, list[np.ndarray]]]:
    """Reads a video by ffmpeg: what is known of it, and its frames."""

    def decoded(path: Path) -> tuple[dict, list[np.ndarray]]:
        # ffmpeg's default conversion rounds down, and makes every picture a level darker.
        exact = ["-vf", "scale=flags=bicubic+accurate_rnd+full_chroma_int+full_chroma_inp,format=rgb24"]
        frames = imageio_ffmpeg.read_frames(str(path), output_params=exact)
        known = next(frames)
        width, height = known["size"]
        return known, [np.frombuffer(data, np.uint8).reshape(height, width, 3) for data in frames]

    return decoded


@pytest.fixture(scope="session")
def _model_master(tmp_path_factory: pytest.TempPathFactory, _colmap_master: Path) -> Path:
    folder = tmp_path_factory.mktemp("paths") / "model"
    model(60, seed=3).save_ply(str(folder / "point_cloud" / "iteration_7" / "point_cloud.ply"))
    (folder / "cfg_args").write_text(f"Namespace(sh_degree=3, source_path={str(_colmap_master)!r}, eval=True)")
    return folder


@pytest.fixture
def out(tmp_path: Path, _model_master: Path) -> Path:
    """A model folder with 60 Gaussians."""
    folder = tmp_path / "model"
    (folder / "point_cloud").parent.mkdir()
    (folder / "point_cloud").symlink_to(_model_master / "point_cloud")
    (folder / "cfg_args").write_bytes((_model_master / "cfg_args").read_bytes())
    return folder


@pytest.fixture
def run(out: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Runs render.py in this process; returns the folder of the videos."""

    def command(*words: object) -> Path:
        monkeypatch.setattr("sys.stdout", sys.stdout)  # which the command replaces
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


def test_the_video_of_a_file_shows_its_frames(run, tmp_path, decoder, capsys):
    PATH.write(tmp_path / "my tour.json")
    folder = run("--path", tmp_path / "my tour.json", "--fps", 20, "--frames")
    pictures = [f"my tour/{n:05d}.png" for n in range(21)]
    assert written(folder) == ["my tour.mp4", *pictures]
    known, frames = decoder(folder / "my tour.mp4")
    assert (known["fps"], known["size"], known["duration"]) == (20, (96, 64), 1.05)
    assert known["codec"] == "h264" and known["pix_fmt"] == "yuv420p(tv, bt709, progressive)"
    assert len(frames) == 21
    scores = [psnr(frame, read(folder / name)) for frame, name in zip(frames, pictures, strict=True)]
    assert min(scores) >= 35, scores
    assert "my tour.mp4: 21 frames of 96 x 64, 1.05 s, " in capsys.readouterr().out
    assert not any((folder.parents[1] / name).exists() for name in ("train", "test"))


def test_a_second_decoder_sees_the_same(tmp_path):
    av = pytest.importorskip("av", reason="PyAV, a second decoder, is not installed")
    given = list(patches(12))
    with video_writer(tmp_path / "a.mp4", 64, 48, 24) as writer:
        for frame in given:
            writer.write(frame)
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.average_rate, stream.frames, stream.duration * stream.time_base) == (24, 12, 0.5)
        code = stream.codec_context
        assert (code.name, code.pix_fmt) == ("h264", "yuv420p")
        # Of ITU-T H.273: limited range, and BT.709 thrice.
        assert (code.color_range, code.colorspace, code.color_primaries, code.color_trc) == (1, 1, 1, 1)
        frames = list(container.decode(stream))
    assert [frame.pts * stream.time_base * 24 for frame in frames] == list(range(12))
    for frame, wanted in zip(frames, given, strict=True):
        error = by_bt709(frame.to_ndarray(format="yuv420p").astype(float), 64, 48) - wanted
        inner = error.reshape(3, 16, 4, 16, 3)[:, 5:11, :, 5:11]  # apart from the edges, where colours mix
        assert np.abs(inner.mean(axis=(0, 1, 2, 3))).max() < 0.8 and np.abs(inner).max() < 12


def by_bt709(planes: np.ndarray, width: int, height: int) -> np.ndarray:
    """RGB (H,W,3) of a frame in yuv420p, by ITU-R BT.709 in limited range; colours of four pixels are one."""
    luma = (planes[:height] - 16) / 219
    halves = planes[height:].reshape(2, height // 2, width // 2).repeat(2, axis=1).repeat(2, axis=2)
    blue, red = (halves - 128) / 224
    r, b = luma + 1.5748 * red, luma + 1.8556 * blue
    return 255 * np.stack([r, (luma - 0.2126 * r - 0.0722 * b) / 0.7152, b], axis=-1)


def test_neither_levels_nor_colours_are_shifted(tmp_path, monkeypatch):
    """H.264 has a value of colour on the left one of two pixels, in the middle of two rows (its figure 6-1)."""
    av = pytest.importorskip("av", reason="PyAV, a second decoder, is not installed")
    monkeypatch.setattr(video, "CRF", 1)
    columns, rows = np.meshgrid(np.arange(96), np.arange(64))
    frame = np.stack([2 * columns, 40 + 0 * rows, 3 * rows], axis=-1).astype(np.uint8)
    with video_writer(tmp_path / "a.mp4", 96, 64, 30) as writer:
        writer.write(frame)
    with av.open(str(tmp_path / "a.mp4")) as container:
        planes = next(container.decode(video=0)).to_ndarray(format="yuv420p").astype(float)
    share = frame / 255
    luma = share @ [0.2126, 0.7152, 0.0722]
    assert abs((planes[:64] - 16 - 219 * luma).mean()) < 0.1
    halves = planes[64:].reshape(2, 32, 48)
    for plane, colour, factor in zip(halves, (share[..., 2], share[..., 0]), (1.8556, 1.5748), strict=True):
        wanted = 128 + 224 * (colour - luma) / factor
        left = (wanted[::2, ::2] + wanted[1::2, ::2]) / 2
        assert abs((plane - left)[4:-4, 4:-4].mean()) < 0.1  # half a pixel would be 0.4


def test_each_generated_path_has_its_name_size_and_length(run, decoder):
    sizes = {"interpolate": (96, 64), "ellipse": (50, 34)}
    for name, size in sizes.items():
        words = [] if name == "interpolate" else ["--size", *size]
        folder = run("--path", name, "--seconds", "0.5", "--fps", "10", *words)
        known, frames = decoder(folder / f"{name}.mp4")
        assert known["size"] == size and len(frames) == (6 if name == "interpolate" else 5)
        assert np.std(frames[0]) > 5  # something is seen
    assert written(folder) == ["ellipse.mp4", "interpolate.mp4"]


def test_the_size_of_odd_photos_is_made_even():
    from moving_cameras.render_path import even_size

    cases = {(97, 64): (96, 64), (96, 65): (96, 64), (1, 1): (2, 2)}
    for (width, height), size in cases.items():
        assert even_size(SimpleNamespace(image_width=width, image_height=height)) == size


def test_the_background_is_the_models_and_exposures_are_not_applied(run, out, tmp_path):
    away = CameraPath(tuple(Keyframe(at, (0, 0, 90 + at), (1, 0, 0, 0), 40) for at in (0, 1)))
    away.write(tmp_path / "away.json")
    images = _source(out) / "images"
    names = [path.relative_to(images).as_posix() for path in images.rglob("*.png")]
    inverted = [[-1, 0, 0, 1], [0, -1, 0, 1], [0, 0, -1, 1]]
    (out / "exposure.json").write_text(json.dumps(dict.fromkeys(names, inverted)))
    options = (out / "cfg_args").read_text()
    for white, trained in ((False, False), (True, False), (True, True)):
        (out / "cfg_args").write_text(options.replace(")", f", white_background={white}, train_test_exp={trained})"))
        folder = run("--path", tmp_path / "away.json", "--fps", 1, "--frames")
        assert (read(folder / "away" / "00000.png") == 255 * white).all()


def test_the_lens_of_a_photo_is_ignored(run, out, tmp_path):
    """The scene's photos have principal points off centre. A path through a camera shows it centred."""
    from moving_cameras.poses import poses_of

    folder = run("--path", "interpolate", "--seconds", "0.5", "--fps", "4", "--frames")
    options = render.ModelParams(render.argparse.ArgumentParser()).extract(
        render.argparse.Namespace(model_path=str(out), source_path=str(_source(out)), eval=True)
    )
    scene = render.load_saved(options, 7)
    first = scene.getTrainCameras()[0]
    assert abs(first.cx - first.image_width / 2) > 1
    pose = poses_of([first])
    matrix = np.eye(4)
    matrix[:3, :3] = pose.turns[0].T
    matrix[:3, 3] = -pose.turns[0].T @ pose.positions[0]
    camera = render.Camera(
        colmap_id=1, R=pose.turns[0], T=matrix[:3, 3], FoVx=first.FoVx, FoVy=first.FoVy, uid=0, image_name="a",
        image=torch.zeros(3, 64, 96), gt_alpha_mask=None,
    )  # fmt: skip
    with torch.no_grad():
        image = render.ScoredViews(pipeline(), torch.zeros(3), False).whole(camera, scene.gaussians)
    shown = read(folder / "interpolate" / "00000.png").astype(float)
    assert np.abs(shown - 255 * image.permute(1, 2, 0).numpy()).max() < 1.5


def _source(out: Path) -> Path:
    return Path((out / "cfg_args").read_text().split("source_path='")[1].split("'")[0])


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


def test_memory_does_not_grow_with_the_length(run, monkeypatch, decoder):
    if not Path("/proc/self/task").is_dir() or not list(Path("/proc/self/task").glob("*/children")):
        pytest.skip("this system does not tell the memory of processes in /proc")
    from moving_cameras import render_path

    drawn, sizes = render_path.render, []

    def watched(*args, **kwargs):
        sizes.append(_resident() if len(sizes) in (150, 599) else 0)
        return drawn(*args, **kwargs)

    monkeypatch.setattr(render_path, "render", watched)
    folder = run("--path", "ellipse", "--seconds", 20, "--size", 160, 120)
    assert len(sizes) == 600
    assert sizes[599] - sizes[150] < 8e6  # the frames between take 26 MB
    known, frames = decoder(folder / "ellipse.mp4")
    assert len(frames) == 600 and known["duration"] == 20


# What is refused


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--fps", "5"), "^--fps is for a path; leave it out, or pass --path, too$"),
        (("--size", "4", "4"), "^--size is for a path"),
        (("--seconds", "4"), "^--seconds is for a path"),
        (("--frames",), "^--frames is for a path"),
        (("--path", "ellipse", "--depth"), "^--depth is for the train and test views; leave it out, or --path$"),
        (("--path", "ellipse", "--alpha"), "^--alpha is for the train and test views"),
        (("--path", "ellipse", "--fps", "0"), "^--fps must be 1 to 240, got 0$"),
        (("--path", "ellipse", "--fps", "241"), "^--fps must be 1 to 240, got 241$"),
        (("--path", "ellipse", "--size", "401", "300"), "odd side.* use --size 400 300$"),
        (("--path", "ellipse", "--size", "400", "3"), "odd side.* use --size 400 2$"),
        (("--path", "ellipse", "--size", "0", "4"), "^--size must be two even numbers of 2 to 16384 pixels, got 0 4$"),
        (("--path", "ellipse", "--size", "4", "16386"), "^--size must be two even numbers"),
        (("--path", "ellipse", "--seconds", "0"), "^--seconds must be 0.1 to 3600, got 0$"),
        (("--path", "ellipse", "--seconds", "nan"), "^--seconds must be 0.1 to 3600, got nan$"),
        (("--path", "ellipse", "--seconds", "4000"), "^--seconds must be 0.1 to 3600, got 4000$"),
        (
            ("--path", "elipse"),
            "^--path must be interpolate, ellipse, spiral or a file of keyframes; there is no file",
        ),
        (("--path", ""), "^--path must be .*there is no file $"),
        (("--path", "x" * 5000), "^--path must be .*there is no file xxx"),
        (("--path", "spiral"), "^--path spiral needs training cameras that face one way"),
    ],
    ids=lambda value: " ".join(value)[:40] if isinstance(value, tuple) else "",
)
def test_a_wrong_option_is_refused(run, out, words, sentence):
    before = written(out)
    with pytest.raises(UserError, match=sentence) as refused:
        run(*words)
    assert "\n" not in str(refused.value) and written(out) == before


def test_a_wrong_file_is_refused(run, out, tmp_path):
    file = tmp_path / "path.json"
    file.write_text("{")
    with pytest.raises(UserError, match="path.json is not JSON"):
        run("--path", file)
    with pytest.raises(UserError, match="cannot read the camera path"):
        run("--path", tmp_path)
    PATH.write(file)
    with pytest.raises(UserError, match="^--seconds is for interpolate, ellipse, spiral; the times of .* stand in it$"):
        run("--path", file, "--seconds", 3)
    keys = json.loads(file.read_text())
    keys["keyframes"] = keys["keyframes"][:1] + keys["keyframes"][-1:]
    for seconds, said in ((4000, "4000"), (5e-324, "4.94066e-324")):
        keys["keyframes"][-1]["seconds"] = seconds
        file.write_text(json.dumps(keys))
        with pytest.raises(UserError, match=f"lasts {said} s, and a path lasts 0.1 to 3600; give the keyframes' times"):
            run("--path", file)
    assert not (out / "videos").exists()


def test_a_missing_ffmpeg_is_said_before_the_model_is_read(run, out, monkeypatch):

    def none() -> str:
        raise RuntimeError("No ffmpeg exe could be found.")

    (out / "point_cloud").unlink()
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", none)
    with pytest.raises(UserError, match="has no ffmpeg program for this machine; install ffmpeg, and name it in"):
        run("--path", "ellipse")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(UserError, match=r"videos need the package imageio-ffmpeg; `pip install '\.\[video\]'`"):
        run("--path", "ellipse")


def _ffmpeg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str) -> None:
    """A stand-in for ffmpeg."""
    program = tmp_path / "ffmpeg"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setattr(video, "find_ffmpeg", lambda: str(program))


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
    _ffmpeg(tmp_path, monkeypatch, script)
    with pytest.raises(UserError, match="^ffmpeg could not write .*ellipse.mp4, after [0-9]+ frames ") as refused:
        run("--path", "ellipse", "--seconds", 1)
    assert f"({reason}); free space there, or choose another --size or place" in str(refused.value)
    assert written(out / "videos") == []


def test_an_ffmpeg_that_cannot_be_started_is_named(run, tmp_path, monkeypatch):
    monkeypatch.setattr(video, "find_ffmpeg", lambda: str(tmp_path / "none"))
    with pytest.raises(UserError, match=r"^cannot start .*none \(No such file or directory\); `pip install "):
        run("--path", "ellipse")


def test_a_lack_of_memory_names_a_smaller_size(run, out, monkeypatch):
    from moving_cameras import render_path

    def fail(*_, **__):
        raise MemoryError

    monkeypatch.setattr(render_path, "render", fail)
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


def test_an_interrupted_video_leaves_nothing(tmp_path):
    started: list[subprocess.Popen] = []
    with pytest.raises(KeyboardInterrupt), video_writer(tmp_path / "a.mp4", 64, 48, 30) as writer:
        started.append(writer._process)
        for frame in patches(3):
            writer.write(frame)
        raise KeyboardInterrupt
    assert started[0].returncode is not None and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("sent", ["SIGTERM", "SIGHUP"])
def test_a_command_that_is_told_to_end_leaves_no_file(out, sent):
    words = ["--path", "ellipse", "--seconds", "3600", "--quiet"]
    with subprocess.Popen([sys.executable, "render.py", "-m", str(out), *words], cwd=ROOT, stderr=-1) as process:
        try:
            wait_for(lambda: written(out / "videos"))
            process.send_signal(getattr(signal, sent))
            said = process.communicate(timeout=LIMIT)[1].decode()
        finally:
            process.kill()
    assert process.returncode == 143 and said.endswith("terminated\n") and "Traceback" not in said
    assert written(out / "videos") == []


def test_names_that_ffmpeg_would_take_for_something_else(tmp_path, monkeypatch, decoder):
    monkeypatch.chdir(tmp_path)
    for name in ("-y.mp4", "a:b.mp4", "pipe:1.mp4", "%d.mp4", "ä ü.mp4"):
        with video_writer(Path(name), 64, 48, 30) as writer:
            for frame in patches(2):
                writer.write(frame)
        assert len(decoder(Path.cwd() / name)[1]) == 2
    assert len(list(tmp_path.iterdir())) == 5


def test_the_command_ends_with_status_2(out):
    command = [sys.executable, "render.py", "-m", str(out), "--path", "ellipse", "--size", "33", "20"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1) and done.stderr.startswith("error: --size 33 20 has")
