"""convert.py --video: frames chosen by motion and sharpness, HDR brought to SDR, several videos, videos with photos."""

import contextlib
import itertools
import json
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from photo_room import make_photos
from PIL import Image, ImageFilter
from scipy.ndimage import gaussian_filter
from skimage.metrics import structural_similarity

import convert
from applications.convert import video as video_module
from applications.convert.layout import Layout
from utils.system_utils import UserError


@pytest.fixture(scope="module")
def ffmpeg():
    return pytest.importorskip("imageio_ffmpeg", reason="no imageio-ffmpeg: pip install '.[video]'")


class _Decoder(SimpleNamespace):
    """A stand-in for imageio_ffmpeg with frames of noise, of which every third is sharp."""

    @staticmethod
    def frame(number: int) -> Image.Image:
        noise = Image.fromarray(np.random.default_rng(number).integers(0, 256, (30, 40, 3), dtype=np.uint8))
        return noise if number % 3 == 1 else noise.reduce(4).resize((40, 30))

    @staticmethod
    def get_ffmpeg_exe() -> str:
        return "false"

    @classmethod
    def read_frames(cls, path: str, pix_fmt: str = "rgb24", output_params: list[str] = (), **_: object):
        yield {"size": (40, 30), "pix_fmt": "yuv420p(tv, bt709)", "duration": 0.3, "fps": 30.0}
        select = next((word for word in output_params if word.startswith("select=")), "")
        for number in range(9):
            if not select or rf"eq(n\,{number})" in select:
                yield cls.frame(number).convert("L" if pix_fmt == "gray" else "RGB").tobytes()


@pytest.fixture
def decoder(monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", _Decoder())


def _frames(layout: Layout) -> list[Path]:
    return sorted(layout.input.rglob("*.jpg"))


def _extract(scene: Path, video: Path, count: int) -> Layout:
    layout = Layout(scene)
    layout.work.mkdir(parents=True)
    video_module.extract_videos(layout, [video], count)
    return layout


def test_the_sharpest_frame_of_each_part_is_taken(tmp_path, decoder):
    layout = _extract(tmp_path / "few", Path("any.mp4"), 3)
    assert [path.name for path in _frames(layout)] == [f"frame_0000{i}.jpg" for i in (1, 2, 3)]
    for index, path in enumerate(_frames(layout)):
        expected = video_module.sharpness(np.asarray(_Decoder.frame(3 * index + 1).convert("L")))
        assert video_module.sharpness(np.asarray(Image.open(path).convert("L"))) == pytest.approx(expected, rel=0.1)
    assert len(_frames(_extract(tmp_path / "all", Path("any.mp4"), 100))) == 9


def test_a_video_makes_its_scene_folder(tmp_path, monkeypatch):
    video, scene = tmp_path / "walk.mp4", tmp_path / "deep" / "new"
    words = ["-s", str(scene), "--video", str(video), "--video_frames", "3", "--mask_path", str(tmp_path)]
    with pytest.raises(UserError, match="no video"):
        convert.main(words)
    video.touch()
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(UserError, match="--video needs the package"):
        convert.main(words)
    assert not scene.parent.exists()
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", _Decoder())
    with pytest.raises(UserError, match="none of 3 photos has a mask"):  # the stage after the frames
        convert.main(words)
    assert len(_frames(Layout(scene))) == 3
    with pytest.raises(UserError, match="no folder .*other; make it"):
        convert.main(["-s", str(tmp_path / "other")])


def test_frames_replace_frames_and_nothing_else(tmp_path, decoder):
    """A photo of the user with the name of a frame is never removed."""
    one, two, layout = tmp_path / "a.mp4", tmp_path / "b.mp4", Layout(tmp_path / "scene")
    one.touch(), two.touch(), layout.input.mkdir(parents=True)
    Image.new("RGB", (40, 30)).save(layout.input / "mine.jpg")
    flat = {f"frame_0000{i}.jpg" for i in (1, 2, 3, 4)}
    both = {f"{stem}/{name}" for stem in "ab" for name in flat}
    for videos, frames in (((one,), flat), ((one, two), both), ((two,), flat)):
        words = ["-s", layout.scene, "--mask_path", tmp_path, "--video_frames", 4, "--video", *videos]
        with pytest.raises(UserError, match="has a mask"):
            convert.main([*map(str, words)])
        found = {path.relative_to(layout.input).as_posix() for path in layout.input.rglob("*.jpg")}
        assert found == frames | {"mine.jpg"}
    other = Layout(tmp_path / "other")
    other.input.mkdir(parents=True)
    Image.new("RGB", (40, 30)).save(other.input / "frame_00002.jpg")
    with pytest.raises(UserError, match="frame_00002.jpg has a name that frames of a.mp4 will get; rename it"):
        convert.main(["-s", str(other.scene), "--video", str(one)])
    assert [path.name for path in _frames(other)] == ["frame_00002.jpg"]


def test_frames_go_by_what_they_are_not_by_what_a_record_says(tmp_path, decoder):
    layout = _extract(tmp_path / "scene", Path("any.mp4"), 4)
    (entry,), frames = json.loads(layout.frames.read_text()), _frames(layout)
    elsewhere = frames[3].rename(tmp_path / "frame_00004.jpg")
    for name in ("../../frame_00004.jpg", str(elsewhere), ".hidden/frame_00004.jpg", "mine.jpg", 5):
        layout.frames.write_text(json.dumps([entry | {"names": [name]}]))
        with pytest.raises(UserError, match="frames.json is damaged; remove "):
            video_module.remove_frames(layout)
    for key in entry:
        for broken in ({name: value for name, value in entry.items() if name != key}, entry | {key: [[]]}):
            layout.frames.write_text(json.dumps([broken]))
            with contextlib.suppress(UserError):  # what it need not have
                video_module.describe_videos(layout)
                video_module.list_report_entries(layout)
    assert elsewhere.is_file()
    layout.frames.write_text(json.dumps([entry]))
    Image.open(frames[1]).rotate(90).save(frames[1])
    with pytest.raises(UserError, match="frame_00002.jpg has a name that frames of any.mp4 will get"):
        video_module.refuse_foreign_frames(layout, [Path("any.mp4")])
    video_module.remove_frames(layout)
    assert _frames(layout) == [frames[1]]


def test_folders_of_frames_stay_in_the_input(tmp_path):
    layout = Layout(tmp_path)
    folders = video_module.frame_folders(layout, [Path("a.mp4"), Path(".b.mp4"), Path("...mp4")])
    assert [folder.relative_to(layout.input).as_posix() for folder in folders] == ["a", "b", "video"]


@pytest.fixture(scope="module")
def room(once) -> np.ndarray:
    """Frames (16, 180, 240, 3) of a camera that moves around the corner of a room."""
    folder = once("room of a video", lambda folder: make_photos(folder, 16))
    return np.stack([np.asarray(Image.open(path)) for path in sorted(folder.iterdir())])


def _write(ffmpeg, path: Path, frames: np.ndarray, *options: str, pixels: str = "rgb24") -> None:
    height, width = frames.shape[1:3]
    given = ["-f", "rawvideo", "-pix_fmt", pixels, "-s", f"{width}x{height}", "-r", "30", "-i", "-"]
    command = [ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", *given, *options, str(path)]
    subprocess.run(command, input=frames.tobytes(), check=True)


def _places(room: np.ndarray, frames: list[np.ndarray]) -> list[int]:
    """The place in the room that each frame shows."""
    return [int(np.abs(room.astype(np.int16) - frame).mean(axis=(1, 2, 3)).argmin()) for frame in frames]


def test_names_are_neither_options_nor_addresses(ffmpeg, room, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for number, name in enumerate(["12:30.mp4", "-x.mp4", "file,5.mp4", "a%03d.mp4", "concat:a.mp4"]):
        _write(ffmpeg, tmp_path / name, room[:2])
        assert _frames(_extract(tmp_path / str(number), Path(name), 2)), name


LEADING = (
    "ffconcat version 1.0\nfile secret.mp4\n",
    "#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:1,\nsecret.mp4\n#EXT-X-ENDLIST\n",
    "v=0\no=- 0 0 IN IP4 127.0.0.1\nc=IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\na=rtpmap:96 H264/90000\n",
)


def test_a_text_does_not_lead_to_other_files(ffmpeg, room, tmp_path):
    _write(ffmpeg, tmp_path / "secret.mp4", room[:2])
    for number, (text, ending) in enumerate(itertools.product(LEADING, ("mp4", "m3u8"))):
        (tmp_path / f"a.{ending}").write_text(text)
        with pytest.raises(UserError, match="cannot read the video .*a.m"):
            _extract(tmp_path / str(number), tmp_path / f"a.{ending}", 2)
        assert not list((tmp_path / str(number) / "input").iterdir())


def _streams(ffmpeg, room, path: Path, *heights: int, width: int = 240) -> None:
    """Write a video with a stream of each height, the first of which players show; each begins later in the room."""
    command, given = [ffmpeg.get_ffmpeg_exe(), "-loglevel", "error"], []
    for number, height in enumerate(heights):
        part = path.with_name(f"{path.stem}_{number}.mkv")
        _write(ffmpeg, part, room[4 * number :][:4], "-vf", f"scale={width * height // 180}:{height}", "-crf", "12")
        command, given = [*command, "-i", str(part)], [*given, "-map", f"{number}:v"]
    subprocess.run([*command, *given, "-c", "copy", "-f", "mp4", str(path)], check=True)


@pytest.mark.parametrize(("heights", "folders", "said"), [
    ((48, 180), {"": 1}, "of its 2 streams, the largest is taken"),
    ((180, 48), {"": 0}, "of its 2 streams, the largest is taken"),
    ((180, 180), {"walk": 0, "walk_2": 1}, "each of its 2 streams of one size is a camera"),
    ((48, 180, 180), {"walk": 1, "walk_2": 2}, "each of its 2 streams of one size is a camera"),
])  # fmt: skip
def test_streams_of_a_video(ffmpeg, room, tmp_path, heights, folders, said):
    _streams(ffmpeg, room, tmp_path / "walk.mp4", *heights)
    layout = _extract(tmp_path / "scene", tmp_path / "walk.mp4", 9)
    for name, first in folders.items():
        taken = [np.asarray(Image.open(path)) for path in sorted((layout.input / name).iterdir())]
        assert _places(room, taken) == list(range(4 * first, 4 * first + 4))
    lines = video_module.describe_videos(layout)
    assert len(lines) == len(folders) and all(said in line for line in lines)


def test_parts_of_a_panorama_are_refused(ffmpeg, room, tmp_path):
    _streams(ffmpeg, room, tmp_path / "GS01.360", 60, 60, width=480)
    with pytest.raises(UserError, match=r"GS01.360 has parts of a panorama in 2 streams; export .*GoPro Player"):
        convert.main(["-s", str(tmp_path / "scene"), "--video", str(tmp_path / "GS01.360")])
    assert not (tmp_path / "scene").exists()


def test_frames_follow_the_motion(ffmpeg, room, tmp_path):
    """A camera that stands, moves, stands for long, and moves at half the speed, with the noise of a sensor."""
    order = [*[0] * 30, *range(8), *[7] * 90, *np.repeat(np.arange(8, 16), 2)]
    noise = np.random.default_rng(0).normal(0, 4, (20, *room.shape[1:])).astype(np.float32)
    frames = [np.clip(room[place] + noise[number % 20], 0, 255) for number, place in enumerate(order)]
    _write(ffmpeg, tmp_path / "walk.mp4", np.stack(frames).astype(np.uint8), "-crf", "18", "-pix_fmt", "yuv420p")
    layout = _extract(tmp_path / "scene", tmp_path / "walk.mp4", 40)
    taken = [np.asarray(Image.open(path)) for path in _frames(layout)]
    pairs = zip(taken[:-1], taken[1:], strict=True)
    assert max(structural_similarity(one, other, channel_axis=2) for one, other in pairs) < 0.9
    assert _places(room, taken) == list(range(16))
    (line,) = video_module.describe_videos(layout)
    assert line == "walk.mp4: 16 of 144 frames taken, not 40, since the others hardly differ"
    # Fewer than there are places: each of equal parts of the motion, not of the time, has one.
    layout = _extract(tmp_path / "few", tmp_path / "walk.mp4", 4)
    assert [place // 4 for place in _places(room, [np.asarray(Image.open(p)) for p in _frames(layout)])] == [0, 1, 2, 3]


def test_more_frames_than_one_sum_of_ffmpeg_holds(ffmpeg, tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (150, 32, 32, 3), dtype=np.uint8)
    _write(ffmpeg, tmp_path / "long.mp4", noise, "-crf", "18", "-pix_fmt", "yuv420p")
    assert len(_frames(_extract(tmp_path / "scene", tmp_path / "long.mp4", 150))) == 150


def test_a_change_of_exposure_is_no_motion(room):
    frame = room[0].mean(axis=2)
    brighter = [video_module.small_picture((frame * factor).astype(np.uint8)) for factor in np.linspace(0.5, 1, 20)]
    assert video_module.choose_frames([1.0] * 20, np.stack(brighter), 20) == [0]


def _pq(light: np.ndarray) -> np.ndarray:
    """The signal of PQ for light in cd/m2: ITU-R BT.2100-2, table 4."""
    power = (light / 10000) ** (2610 / 16384)
    return ((3424 / 4096 + 2413 / 128 * power) / (1 + 2392 / 128 * power)) ** (2523 / 32)


def _hlg(light: np.ndarray) -> np.ndarray:
    """The signal of HLG for light (..., 3) in cd/m2 of a display of 1000 cd/m2: ITU-R BT.2100-2, table 5."""
    luminance = np.maximum(light @ [0.2627, 0.6780, 0.0593], 1e-6) / 1000
    scene = light / 1000 * (luminance ** (1 / 1.2 - 1))[..., None]
    high = 0.17883277 * np.log(np.maximum(12 * scene - 0.28466892, 1e-9)) + 0.55991073
    return np.where(scene <= 1 / 12, np.sqrt(3 * scene), high)


SIGNALS = {"arib-std-b67": _hlg, "smpte2084": _pq}
TO_2020 = np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]])  # ITU-R BT.2087
WHITE = 203  # cd/m2, ITU-R BT.2408


ALL_TAGS = "color_primaries=bt2020:colorspace=bt2020nc:range=tv"


def _write_hdr(ffmpeg, path: Path, light: np.ndarray, transfer: str, tagged: str = ALL_TAGS) -> None:
    """Write light (F, H, W, 3) of BT.2020 in cd/m2 as a phone does: 10 bits, H.265, with the transfer in its tags."""
    signal = np.round(np.clip(SIGNALS[transfer](light), 0, 1) * 65535).astype("<u2")
    to_yuv = f"setparams=color_primaries=bt2020:color_trc={transfer},zscale=min=gbr:rin=pc:m=bt2020nc:r=tv:f=bicubic"
    tags = f"format=yuv420p10le,setparams=color_trc={transfer}:{tagged}"
    coded = ["-c:v", "libx265", "-x265-params", "log-level=error:crf=10:pools=1"]
    _write(ffmpeg, path, signal, "-vf", f"{to_yuv},{tags}", *coded, pixels="rgb48le")


def _light(frames: np.ndarray) -> np.ndarray:
    """Light of BT.2020 that an SDR display shows for frames of BT.709 (BT.1886: a power of 2.4)."""
    return (frames / 255.0) ** 2.4 * WHITE @ TO_2020.T


@pytest.mark.parametrize(("transfer", "name"), [("arib-std-b67", "HLG"), ("smpte2084", "PQ")])
def test_hdr_frames_look_like_those_of_the_sdr_video(ffmpeg, room, tmp_path, transfer, name):
    # Blurred, since videos have colours at half the size.
    source = np.stack([np.asarray(Image.fromarray(frame).filter(ImageFilter.GaussianBlur(1.5))) for frame in room[::5]])
    # BT.2408 gives white these signals.
    assert SIGNALS[transfer](np.full((1, 3), 203.0)) == pytest.approx({"HLG": 0.75, "PQ": 0.58}[name], abs=0.001)
    _write_hdr(ffmpeg, tmp_path / "hdr.mov", _light(source), transfer)
    tags = "setparams=colorspace=bt709:color_primaries=bt709:color_trc=bt709"
    bt709 = f"scale=out_color_matrix=bt709,format=yuv420p,{tags}"
    _write(ffmpeg, tmp_path / "sdr.mp4", source, "-crf", "10", "-vf", bt709)
    for kind in ("hdr.mov", "sdr.mp4"):
        layout = _extract(tmp_path / kind[:3], tmp_path / kind, 9)
        taken = np.stack([np.asarray(Image.open(path)) for path in _frames(layout)]).astype(float)
        assert taken.shape == source.shape
        for got, expected in zip(taken.reshape(len(source), -1, 3), source.reshape(len(source), -1, 3), strict=True):
            assert got.mean(axis=0) == pytest.approx(expected.mean(axis=0), rel=0.03)
            assert got.std(axis=0) == pytest.approx(expected.std(axis=0), rel=0.03)
        (line,) = video_module.describe_videos(layout)
        assert (f"; {name} was brought to SDR" in line) == (kind == "hdr.mov")


def test_tags_that_are_missing(ffmpeg, room, tmp_path):
    few, none = tmp_path / "few.mov", tmp_path / "none.mov"
    _write_hdr(ffmpeg, few, _light(room[:1]), "smpte2084", "color_primaries=unknown:colorspace=unknown")
    (path,) = _frames(_extract(tmp_path / "few", few, 3))
    assert np.asarray(Image.open(path)).mean() == pytest.approx(room[0].mean(), rel=0.03)
    _write_hdr(ffmpeg, none, _light(room[:1]), "smpte2084", f"{ALL_TAGS}:color_trc=unknown")
    with pytest.raises(UserError, match="none.mov has the colours of HDR .* does not say which transfer function"):
        _extract(tmp_path / "none", none, 3)


def test_an_ffmpeg_that_can_not_convert_hdr_is_refused(ffmpeg, room, tmp_path, monkeypatch):
    _write_hdr(ffmpeg, tmp_path / "hdr.mov", _light(room[:3]), "arib-std-b67")
    program = tmp_path / "ffmpeg"
    real = ffmpeg.get_ffmpeg_exe()
    program.write_text(f'#!/bin/sh\ncase "$*" in *-filters*) echo ".. scale V->V";; *) exec {real} "$@";; esac\n')
    program.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))
    with pytest.raises(UserError, match="lacks the filters zscale and tonemap.*or export the video as SDR$"):
        _extract(tmp_path / "scene", tmp_path / "hdr.mov", 3)
    assert not list((tmp_path / "scene" / "input").iterdir())


def test_a_turned_video_gives_upright_frames_without_a_warning(ffmpeg, room, tmp_path, caplog):
    _write(ffmpeg, tmp_path / "flat.mp4", room[:3], "-crf", "10", "-pix_fmt", "yuv420p")
    command = [ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-display_rotation", "90", "-i", tmp_path / "flat.mp4"]
    subprocess.run([*command, "-c", "copy", tmp_path / "turned.mp4"], check=True)
    layout = _extract(tmp_path / "scene", tmp_path / "turned.mp4", 3)
    assert not caplog.records
    taken = np.asarray(Image.open(_frames(layout)[0]).convert("L")).astype(float)
    expected = np.rot90(np.asarray(Image.fromarray(room[0]).convert("L")))
    assert np.abs(taken - expected).mean() < 4 < 20 < np.abs(taken - expected[::-1, ::-1]).mean()  # of 0 to 255


@pytest.mark.parametrize(("order", "coded", "name"), [
    ("top", ["-c:v", "mpeg2video", "-flags", "+ilme+ildct"], "a.mpg"), ("bottom", ["-c:v", "ffv1"], "a.mkv"),
    ("top", ["-c:v", "mjpeg", "-field_order", "tt", "-pix_fmt", "yuvj420p"], "a.mov"),  # does not mark its frames
])  # fmt: skip
def test_interlaced_frames_are_not_combed_and_their_pixels_become_square(ffmpeg, room, tmp_path, order, coded, name):
    image = gaussian_filter(room[0].astype(np.float32), (3, 3, 0))  # bwdif rounds fine patterns
    moved = np.stack([np.roll(image, 6 * number, axis=1) for number in range(16)]).astype(np.uint8)
    woven = f"tinterlace=interleave_{order},setsar=4/3"
    _write(ffmpeg, tmp_path / name, moved, "-vf", woven, "-q:v", "2", *coded)
    layout = _extract(tmp_path / "scene", tmp_path / name, 10)
    frames = [np.asarray(Image.open(path)) for path in _frames(layout)]
    assert len(frames) == 8 and {frame.shape for frame in frames} == {(180, 320, 3)}
    stretched = [np.asarray(Image.fromarray(frame).resize((320, 180))) for frame in moved]
    assert _places(np.stack(stretched), frames) == list(range(0, 16, 2))
    errors = [np.abs(frame.astype(np.float32) - own).mean() for frame, own in zip(frames, stretched[::2], strict=True)]
    assert max(errors) < 6
    (line,) = video_module.describe_videos(layout)
    assert "interlaced, so" in line and line.endswith("not square, so 240 x 180 became 320 x 180")


def test_a_video_that_was_cut_short_is_said(ffmpeg, room, tmp_path, capsys):
    """By its end, not by its number of frames: there may be fewer, farther apart, and nothing missing."""
    frames, quick = np.repeat(room[::2], 4, axis=0), ("-preset", "ultrafast", "-pix_fmt", "yuv420p")
    _write(ffmpeg, tmp_path / "whole.mkv", frames, "-g", "8", *quick)
    content = (tmp_path / "whole.mkv").read_bytes()
    (tmp_path / "cut.mkv").write_bytes(content[: len(content) // 2])
    sparse = "select='lt(n,8)+not(mod(n,4))'", "-fps_mode", "vfr"
    _write(ffmpeg, tmp_path / "sparse.mkv", frames, "-vf", *sparse, *quick)
    for name, said in (("cut", True), ("whole", False), ("sparse", False)):
        _extract(tmp_path / name, tmp_path / f"{name}.mkv", 3)
        warned = re.search(r"warning: cut.mkv ends after [01]\.\d of 1.1 seconds; if it was", capsys.readouterr().err)
        assert (warned is not None) == said


@pytest.mark.slow
def test_two_videos_and_photos_make_one_scene(ffmpeg, room, tmp_path, capsys):
    layout = Layout(tmp_path / "scene")
    layout.input.mkdir(parents=True)
    for number in (1, 8, 13):
        Image.fromarray(room[number]).save(layout.input / f"photo_{number}.png")
    for name, frames in (("left.mp4", room[2:7]), ("right.mp4", room[9:13])):
        _write(ffmpeg, tmp_path / name, np.repeat(frames, 3, axis=0), "-crf", "12", "-pix_fmt", "yuv420p")
    videos = ["--video", str(tmp_path / "left.mp4"), str(tmp_path / "right.mp4")]
    convert.main(["-s", str(layout.scene), "--no_gpu", *videos])
    said = capsys.readouterr().out
    assert "left.mp4: 5 of 15 frames taken, not 150, since the others hardly differ" in said
    assert "12 of 12 photos placed" in said and f"note: {video_module.NOTE}" in said
    content = json.loads(layout.report.read_text())
    assert content["notes"] == [video_module.NOTE] and content["matcher"] == "auto"
    of_each = [[video[key] for key in ("video", "frames", "taken", "asked", "hdr")] for video in content["videos"]]
    assert of_each == [["left.mp4", 15, 5, 150, ""], ["right.mp4", 12, 4, 150, ""]]
    model = pycolmap.Reconstruction(layout.sparse / "0")
    assert {image.name for image in model.images.values()} >= {"left/frame_00005.jpg", "right/frame_00004.jpg"}
    convert.main(["-s", str(layout.scene), "--no_gpu", *videos])
    assert "reused from an earlier run: video, photos, features, matching, mapping" in capsys.readouterr().out
