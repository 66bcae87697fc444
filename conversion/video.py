"""Frames of a video as photos: the sharpest frame of each of N equal spans of time."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from tqdm import tqdm

from conversion.photos import JPEG_QUALITY
from utils.system_utils import UserError

PATTERN = "frame_[0-9][0-9][0-9][0-9][0-9].jpg"
_STEP = 4  # sharpness is computed on every 4th row and column


def extract_frames(video: Path, folder: Path, count: int) -> None:
    """Write at most `count` upright frames into `folder` as frame_00001.jpg, ...; UserError if that fails.

    Reads every frame, and keeps the one in each span whose neighbouring pixels differ most, since parts of hand-held
    videos are blurred.
    """
    decoder = find_decoder()
    try:
        total, _ = decoder.count_frames_and_secs(str(video))
        total = max(total, 1)
        spans = min(count, total)
        written, best, best_sharpness = 0, None, -1.0
        for index, frame in enumerate(tqdm(_frames(decoder, video), total=total, desc="Reading video", unit="frame")):
            span = min(index * spans // total, spans - 1)
            if span > written and best is not None:
                written, best, best_sharpness = _write(best, folder, written), None, -1.0
            if (value := sharpness(frame)) > best_sharpness:
                best, best_sharpness = frame, value
        if best is not None:
            _write(best, folder, written)
    except (OSError, RuntimeError) as error:
        reason = str(error).strip().splitlines()
        raise UserError(
            f"cannot read the video {video} ({reason[-1] if reason else type(error).__name__}); pass another file as "
            f"--video, or put frames of it as JPEG into {folder}"
        ) from error


def sharpness(frame: np.ndarray) -> float:
    """Return the mean squared difference of neighbouring green values along both axes of a frame (H, W, 3) uint8."""
    rows, columns = frame[::_STEP, :, 1].astype(np.int16), frame[:, ::_STEP, 1].astype(np.int16)
    return sum(
        float(np.mean(np.square(np.diff(lines, axis=axis), dtype=np.float64)))
        for axis, lines in ((1, rows), (0, columns))
    )


def _frames(decoder: Any, video: Path) -> Iterator[np.ndarray]:
    frames = decoder.read_frames(str(video))
    width, height = next(frames)["size"]
    for data in frames:
        yield np.frombuffer(data, np.uint8).reshape(height, width, 3)


def _write(frame: np.ndarray, folder: Path, written: int) -> int:
    path = folder / f"frame_{written + 1:05d}.jpg"
    Image.fromarray(frame).save(path, quality=JPEG_QUALITY, subsampling=0)
    return written + 1


def find_decoder() -> Any:
    """Return the package that reads videos. UserError if it is not installed."""
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise UserError(
            "--video needs the package imageio-ffmpeg; `pip install imageio-ffmpeg`, or put frames of the video into "
            "the folder input yourself"
        ) from error
    return imageio_ffmpeg
