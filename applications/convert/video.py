"""Frames of videos as photos: chosen by motion and sharpness, and brought from HDR to the range of a display.

ffmpeg reads each video twice: first as grey pictures, which tell motion and sharpness, then the frames that are taken.
"""

import logging
import math
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from applications.convert.images import JPEG_QUALITY
from applications.convert.layout import Layout
from groundwork.files.json_files import read_json, write_json
from groundwork.files.ours import is_ours, write_picture
from groundwork.host.programs import forget_relative_path
from groundwork.host.progress import Bar
from utils.system_utils import UserError, mkdir_p

# ffmpeg goes by a file's content, and a text can be a list of other files or addresses. These formats are one file.
_ONE_FILE = [
    *("-protocol_whitelist", "file", "-format_whitelist"),
    "mov,matroska,avi,mpegts,mpeg,mpegvideo,asf,flv,ogg,mxf,gif,apng,yuv4mpegpipe,h264,hevc,mjpeg,jpeg_pipe,dv,ivf,obu,nut,"
    "rm",
]
PATTERN = "frame_[0-9][0-9][0-9][0-9][0-9].jpg"  # of a video's frames
# Of ffmpeg's description of a file: number, codec, colours and size of a stream that is no cover picture.
_STREAM = re.compile(r"^ *Stream #0:(\d+).*?: Video: (?!.*\(attached pic\))(.*?), (.*?), (\d+)x(\d+)\b", re.MULTILINE)
_HALF = 2.5  # width by height, from which on a stream is half of a panorama; a lens has 1 to 2
_NAME = re.compile(r"([^/.][^/]*/)?frame_\d{5,}\.jpg")  # below `input`, which a record of others may not leave
# Difference between frames that follow each other (`_is_different`): photos of fox_raw, monstree_raw and bonsai_full
# reach it when they move by 0.3 to 0.6 % of their width; strong noise (6 of 255 levels) reaches 0.03.
LEAST = 0.1
_SIDE = 48  # of the small pictures that are compared
_STEP = 4  # sharpness is computed on every 4th row and column
_WHOLE = 0.9  # of the length that a file tells of itself; sound often ends a little after the picture
_EVERY_FRAME = ["-fps_mode", "passthrough"]  # else frames are doubled or dropped where their times are uneven
# Pixels that are not square, as of DV, are stretched along the side that they are short along; others stay as they are.
_SQUARE = "scale=w=round(iw*max(1\\,sar)):h=round(ih*max(1\\,1/sar))"
_HDR = {"arib-std-b67": "HLG", "smpte2084": "PQ"}  # ffmpeg's names of the transfer functions of ITU-R BT.2100
# agamma=0: zscale's approximation of HLG leaves out that its gamma is that of the luminance, and saturates colours.
# BT.2408: white of an SDR picture is shown at 203 cd/m2, and both functions reach 1000, which is 4.93 times that. Up to
# nine tenths of white nothing changes; what is brighter is compressed into the last tenth.
_LINEAR = "zscale=t=linear:npl=203:agamma=0:f=bicubic,format=gbrpf32le,zscale=p=bt709"
_COMPRESSED = "tonemap=mobius:param=0.9:peak=4.93:desat=0"
_DISPLAY = "zscale=t=bt709:m=gbr:r=pc,format=gbrp"
# What the scores of frames do not tell.
NOTE = "test views of --eval lie between frames of the same video that train; other places may score lower"
FRAMES_MISSING = "an earlier run ended before it had all frames of its video; pass that --video again to add the others"


class Stream(NamedTuple):
    """A stream of a video with several: ffmpeg's options for it, differences in its header, and a text for the user."""

    options: list[str]
    header: dict[str, str]
    said: list[str]


def find_streams(video: Path) -> list[Stream]:
    """Find the streams to take frames of: the largest, or all of that size, as of two lenses.

    UserError for parts of a panorama, which no lens has taken.
    """
    try:
        command = [find_decoder().get_ffmpeg_exe(), "-hide_banner", *_ONE_FILE, "-i", _make_absolute(video)]
        described = subprocess.run(command, capture_output=True, text=True, errors="replace").stderr
    except (OSError, RuntimeError):  # reading the frames will tell
        described = ""
    found = _STREAM.findall(described)
    if len(found) < 2:
        return [Stream([], {}, [])]
    size = max(((int(width), int(height)) for *_, width, height in found), key=math.prod)
    taken = [stream for stream in found if (int(stream[3]), int(stream[4])) == size]
    said = f"of its {len(found)} streams, the largest is taken"
    if len(taken) > 1:
        said = f"each of its {len(taken)} streams of one size is a camera (of fisheyes: --camera OPENCV_FISHEYE)"
        if size[0] >= _HALF * size[1]:
            raise UserError(
                f"{video} has parts of a panorama in {len(taken)} streams; export it as one equirectangular video with "
                "the program of the camera's maker (for .360: GoPro Player), and pass that"
            )
    return [Stream(["-map", f"0:{k}"], {"codec": codec, "pix_fmt": kind}, [said]) for k, codec, kind, *_ in taken]


def _list_streams(layout: Layout, videos: Sequence[Path]) -> list[tuple[Path, Stream, Path]]:
    """Return each video with each stream that is taken, and the folder of its frames."""
    pieces = [(video, stream) for video in videos for stream in find_streams(video)]
    folders = frame_folders(layout, [video for video, _ in pieces])
    return [(*piece, folder) for piece, folder in zip(pieces, folders, strict=True)]


def find_decoder() -> Any:
    """Return the package that reads videos. UserError if it is not installed."""
    forget_relative_path()  # as imageio-ffmpeg looks there, too
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise UserError(
            "--video needs the package imageio-ffmpeg; `pip install '.[video]'`, or put frames of the video into "
            "the folder input yourself"
        ) from error
    # It warns of every turned video, as phones make them; the frames are upright all the same.
    logging.getLogger("imageio_ffmpeg").setLevel(logging.ERROR)
    return imageio_ffmpeg


def frame_folders(layout: Layout, videos: Sequence[Path]) -> list[Path]:
    """The folder of each video's frames: `input` of one alone, of several a sub-folder each, named by the video.

    A video stands there once for each of its streams.
    """
    if len(videos) == 1:
        return [layout.input]
    stems = [video.stem.lstrip(".") or "video" for video in videos]  # hidden folders are not looked into
    return [
        layout.input / (stem if stems.index(stem) == place else f"{stem}_{place + 1}")
        for place, stem in enumerate(stems)
    ]


def list_taken_frames(layout: Layout) -> set[str]:
    """Names, below `input`, of the frames that an earlier run wrote or was about to write."""
    return {name for entry in _read_record(layout) for name in entry["names"]}


def refuse_foreign_frames(layout: Layout, videos: Sequence[Path]) -> None:
    """Raise UserError if a file that is no frame of an earlier run has a name that frames may get."""
    ours = {layout.input / name for name in list_taken_frames(layout)}
    for video, _, folder in _list_streams(layout, videos):
        foreign = [path for path in sorted(folder.glob(PATTERN)) if not (path in ours and is_ours(path))]
        if foreign:
            raise UserError(
                f"{foreign[0]} has a name that frames of {video.name} will get; rename it, or convert the video in "
                "another folder"
            )


def remove_frames(layout: Layout) -> None:
    """Remove the frames of an earlier run, but for those that were changed since."""
    for path in (layout.input / name for name in list_taken_frames(layout)):
        if is_ours(path):
            path.unlink()
    layout.frames.unlink(missing_ok=True)


def extract_videos(layout: Layout, videos: Sequence[Path], count: int) -> None:
    """Write at most `count` frames of each video below `input`, and `frames.json`, which says what they are."""
    for video, stream, folder in _list_streams(layout, videos):
        mkdir_p(folder)
        extract_frames(layout, video, folder, count, stream)


def list_report_entries(layout: Layout) -> list[dict[str, Any]]:
    """List for each video of `frames.json` its name, its frames, those asked for and taken, and its HDR."""
    kept = ("video", "frames", "asked", "hdr")
    return [{"taken": len(entry["names"]), **{key: entry[key] for key in kept}} for entry in _read_record(layout)]


def describe_videos(layout: Layout) -> list[str]:
    """Describe the frames, a line for each video: number taken, why fewer than asked, and conversions."""
    lines = []
    for entry in _read_record(layout):
        taken, text = len(entry["names"]), f"{entry['video']}: {len(entry['names'])} of {entry['frames']} frames taken"
        if taken < entry["asked"]:
            all_taken = taken == entry["frames"]
            text += f", not {entry['asked']}, since " + ("it has no more" if all_taken else "the others hardly differ")
        made = [f"{entry['hdr']} was brought to SDR"] if entry["hdr"] else []
        lines.append("; ".join([text, *made, *entry.get("made", ())]))
    return lines


def _read_record(layout: Layout) -> list[dict[str, Any]]:
    """Read frames.json: for each video its name, options and the names of its frames in `input`.

    UserError if the file is damaged.
    """
    try:
        record = read_json(layout.frames) if layout.frames.is_file() else []
        for entry in record:
            sound = all(map(_NAME.fullmatch, entry["names"])) and all(map(str.isprintable, entry.get("made", ())))
            if [type(entry[key]) for key in ("video", "frames", "asked", "hdr")] != [str, int, int, str] or not sound:
                raise ValueError
        return record
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise UserError(f"{layout.frames} is damaged; remove {layout.work} to convert from the beginning") from error


def extract_frames(layout: Layout, video: Path, folder: Path, count: int, stream: Stream) -> None:
    """Write at most `count` upright frames of a video into `folder` as frame_00001.jpg, ...; add it to frames.json.

    The frames are those of `choose_frames`. UserError if the video cannot be read.
    """
    decoder = find_decoder()
    try:
        sharp, small = [], []
        told = next(decoder.read_frames(_make_absolute(video), input_params=_ONE_FILE, output_params=stream.options))
        header = told | stream.header
        colours = header["pix_fmt"]
        fields = _list_deinterlace_filters(colours, header.get("codec", ""))
        options = [*stream.options, "-vf", ",".join([*fields, _SQUARE]), *_EVERY_FRAME]
        grey = {"pix_fmt": "gray", "bits_per_pixel": 8}
        reader = decoder.read_frames(_make_absolute(video), input_params=_ONE_FILE, output_params=options, **grey)
        width, height = next(reader)["size"]
        expected = round(header["duration"] * header["fps"]) or None
        for data in Bar(reader, total=expected, desc=f"Reading {video.name}", unit="frame"):
            frame = np.frombuffer(data, np.uint8).reshape(height, width)
            sharp.append(sharpness(frame))
            small.append(small_picture(frame))
        if not small:
            raise RuntimeError("it has no frames")
        if expected and len(small) < _WHOLE * expected:
            _warn_if_cut(decoder, video, header["duration"], stream.options)
        chosen = choose_frames(sharp, np.stack(small), count)
        hdr = next((name for tag, name in _HDR.items() if tag in colours), "")
        filters = _list_sdr_filters(decoder, video, colours, bool(hdr))
        paths = [folder / f"frame_{number + 1:05d}.jpg" for number in range(len(chosen))]
        names = [path.relative_to(layout.input).as_posix() for path in paths]
        entry = {"video": video.name, "frames": len(small), "asked": count, "names": names, "hdr": hdr}
        stored = "{} x {}".format(*header["size"])
        entry["made"] = stream.said + ["it is interlaced, so one of two fields makes each frame"] * bool(fields)
        if (width, height) != tuple(header["size"]):
            entry["made"].append(f"its pixels are not square, so {stored} became {width} x {height}")
        write_json(layout.frames, [*_read_record(layout), entry])
        for path, frame in zip(paths, _read_frames(decoder, video, chosen, stream, fields, filters), strict=True):
            write_picture(path, Image.fromarray(frame), quality=JPEG_QUALITY, subsampling=0)
    except (OSError, RuntimeError, ValueError, StopIteration) as error:
        reason = str(error).strip().splitlines()
        if "not on whitelist" in str(error):
            reason = ["it is no file of a video, but may be a list of others"]
        raise UserError(
            f"cannot read the video {video} ({reason[-1] if reason else type(error).__name__}); pass another file as "
            f"--video, or put frames of it as JPEG into {folder}"
        ) from error


def _make_absolute(video: Path) -> str:
    """Return the absolute path of a video: ffmpeg takes a bare "12:30.mp4" for a protocol."""
    return os.path.abspath(video)


def _warn_if_cut(decoder: Any, video: Path, duration: float, options: list[str]) -> None:
    """Say where the frames of a video end before its duration (seconds); fewer of them may only be far apart."""
    copied = [
        *(options or ("-map", "0:v:0")),
        "-c",
        "copy",
        "-f",
        "null",
        "-",
        "-v",
        "quiet",
        "-nostats",
        "-progress",
        "-",
    ]
    command = [decoder.get_ffmpeg_exe(), *_ONE_FILE, "-i", _make_absolute(video), *copied]
    said = subprocess.run(command, capture_output=True, text=True, errors="replace").stdout
    ends = [int(number) / 1e6 for number in re.findall(r"out_time_us=(\d+)", said)]
    if ends and max(ends) < _WHOLE * duration:
        print(
            f"warning: {video.name} ends after {max(ends):.1f} of {duration:.1f} seconds; if it was cut "
            "short, copy it again",
            file=sys.stderr,
        )


def choose_frames(sharp: Sequence[float], small: np.ndarray, count: int) -> list[int]:
    """Return the numbers of at most `count` frames, ascending, each of which differs by LEAST from the one before it.

    The motion of the video is divided into equal parts; of each the sharpest frame is taken that differs from the last
    one. Motion is counted in steps: one step ends where the picture differs by LEAST from the step's beginning. So a
    camera that stands still adds nothing, however long, and slow motion counts.

    sharp: of `sharpness`; small: (F, P) of `small_picture`.
    """
    steps, first = np.zeros(len(small), dtype=np.int64), small[0]
    for number, picture in enumerate(small[1:], 1):
        moved = _is_different(picture, first)
        steps[number] = steps[number - 1] + moved
        first = picture if moved else first
    total = int(steps[-1]) + 1
    parts = steps * min(count, total) // total
    chosen: list[int] = []
    for part in range(min(count, total)):
        there = np.flatnonzero(parts == part)
        new = [number for number in there if not chosen or _is_different(small[number], small[chosen[-1]])]
        if new:
            chosen.append(int(max(new, key=lambda number: sharp[number])))
    return chosen


def sharpness(frame: np.ndarray) -> float:
    """Return the mean squared difference of neighbouring values along both axes of a grey frame (H, W) uint8."""
    rows, columns = frame[::_STEP].astype(np.int16), frame[:, ::_STEP].astype(np.int16)
    changes = np.diff(rows, axis=1), np.diff(columns, axis=0)
    return sum(float(np.square(change, dtype=np.float64).mean()) for change in changes)


def small_picture(frame: np.ndarray) -> np.ndarray:
    """A grey frame (H, W) as (P,) float16 of mean 0 and deviation 1, so that neither exposure nor contrast counts."""
    picture = np.asarray(Image.fromarray(frame).resize((_SIDE, _SIDE), Image.Resampling.BOX), dtype=np.float32).ravel()
    return ((picture - picture.mean()) / max(float(picture.std()), 1.0)).astype(np.float16)


def _is_different(one: np.ndarray, other: np.ndarray) -> bool:
    """Tell if the root mean square of the difference of two small pictures is LEAST or more."""
    return float(np.sqrt(np.square(one.astype(np.float32) - other.astype(np.float32)).mean())) >= LEAST


def _list_sdr_filters(decoder: Any, video: Path, colours: str, hdr: bool) -> list[str]:
    """ffmpeg's filters from the colours of a stream, as its header has them, to BT.709; none if it has those already.

    UserError if this ffmpeg lacks the filters, or if the stream does not name its transfer function.
    """
    if not hdr and "bt2020" not in colours:
        return []
    # The header has matrix/primaries/transfer.
    if not hdr and colours.rpartition("/")[2].startswith("unknown"):
        raise UserError(
            f"{video} has the colours of HDR (BT.2020), but does not say which transfer function it has (HLG or PQ); "
            "export the video as SDR"
        )
    program = decoder.get_ffmpeg_exe()
    done = subprocess.run([program, "-hide_banner", "-filters"], capture_output=True, text=True, errors="replace")
    if not {"zscale", "tonemap"} <= set(done.stdout.split()):
        raise UserError(
            f"{video} has the colours of HDR (BT.2020), and {program} lacks the filters zscale and tonemap to convert "
            "them; unset IMAGEIO_FFMPEG_EXE to use the ffmpeg of imageio-ffmpeg, or export the video as SDR"
        )
    # Streams may leave out the others.
    known = ["setparams=color_primaries=bt2020:colorspace=bt2020nc"] if "unknown" in colours else []
    return [*known, _LINEAR, *([_COMPRESSED] if hdr else []), _DISPLAY]


def _make_select_expression(numbers: Sequence[int]) -> str:
    """ffmpeg's expression for frames of these numbers: a balanced tree, as ffmpeg 8 refuses sums of over 100 terms."""
    half = len(numbers) // 2
    return (
        f"({_make_select_expression(numbers[:half])}+{_make_select_expression(numbers[half:])})"
        if half
        else rf"eq(n\,{numbers[0]})"
    )


def _list_deinterlace_filters(colours: str, codec: str = "") -> list[str]:
    """ffmpeg's filter that makes frames of the fields of an interlaced video; none of any other video."""
    found = re.search(r"\b(top|bottom) (coded )?first\b", colours)
    # A header "(tv, top coded first (swapped))" ends at its comma here.
    if not found and colours.count("(") == colours.count(")") and not codec.startswith("dvvideo"):
        return []  # in files of DV, only the frames tell it
    # Programs disagree on what "swapped" is, so the frames tell it. Those of MJPEG tell nothing, and are all taken.
    parity = "auto" if not found or found[2] else {"top": "tff", "bottom": "bff"}[found[1]]
    return [f"bwdif=mode=send_frame:parity={parity}:deint=all"]


def _read_frames(
    decoder: Any, video: Path, numbers: Sequence[int], stream: Stream, before: list[str], filters: list[str]
) -> Iterator[np.ndarray]:
    """Yield the frames (H, W, 3) uint8 of these numbers. before: filters that need the frames around them."""
    chain = ",".join([*before, f"select={_make_select_expression(numbers)}", _SQUARE, *filters])
    options = [*stream.options, "-vf", chain, *_EVERY_FRAME, "-frames:v", str(len(numbers))]
    reader = decoder.read_frames(_make_absolute(video), input_params=_ONE_FILE, output_params=options)
    width, height = next(reader)["size"]
    for data in reader:
        yield np.frombuffer(data, np.uint8).reshape(height, width, 3)
