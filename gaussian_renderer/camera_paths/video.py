"""H.264 videos from frames that come one by one, written by the ffmpeg of the package imageio-ffmpeg."""

import contextlib
import re
import subprocess
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import IO

import numpy as np

from groundwork.host.programs import find_program, forget_relative_path
from utils.system_utils import UserError, atomic_write

# Of x264, 0 to 51, smaller is better. At 16 a render keeps 35 dB and more; what is lost is colour at edges, as yuv420p
# has one value of it for four pixels.
CRF = 16
_WAIT = 60  # seconds for ffmpeg to end after its input has


def find_ffmpeg() -> str:
    """Path of the ffmpeg program. UserError without the package or the program."""
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise UserError("videos need the package imageio-ffmpeg; `pip install '.[video]'` installs it") from error
    forget_relative_path()  # as imageio-ffmpeg looks there, too
    try:
        program = find_program(imageio_ffmpeg.get_ffmpeg_exe())
    except RuntimeError:
        program = None
    if program is None:
        raise UserError(
            "the package imageio-ffmpeg has no ffmpeg program for this machine; install ffmpeg, and name it in the "
            "environment variable IMAGEIO_FFMPEG_EXE"
        )
    return program


def write_video(path: Path, frames: Iterable[np.ndarray], width: int, height: int, fps: int) -> None:
    """Write frames (H,W,3) uint8 sRGB, of an even width and height, as a video of `fps` frames a second.

    H.264 in yuv420p, limited range, flagged as BT.709, at the constant quality CRF. The file appears whole or not at
    all. Memory does not depend on the number of frames. UserError if ffmpeg is missing, or with its last line if it
    fails.
    """
    program = find_ffmpeg()
    with atomic_write(path) as temporary, tempfile.TemporaryFile() as said:
        command = [program, *_list_arguments(width, height, fps), f"file:{temporary}"]
        # In a session of its own Ctrl-C does not reach it; it is ended below.
        streams = {"stdin": subprocess.PIPE, "stdout": subprocess.DEVNULL, "stderr": said}
        try:
            process = subprocess.Popen(command, **streams, start_new_session=True)
        except OSError as error:
            raise UserError(
                f"cannot start {program} ({error.strerror}); `pip install --force-reinstall imageio-ffmpeg` brings it "
                "back, or name another ffmpeg in the environment variable IMAGEIO_FFMPEG_EXE"
            ) from error
        count = 0
        try:
            for frame in frames:
                if not _try_to_write(process.stdin.write, np.ascontiguousarray(frame).data):
                    raise _explain_failure(process, said, path, count)
                count += 1
            if not _try_to_write(process.stdin.close) or process.wait():
                raise _explain_failure(process, said, path, count)
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
            _try_to_write(process.stdin.close)


def _try_to_write(act: Callable[..., object], *values: object) -> bool:
    """Call `act`, which writes to ffmpeg; False if ffmpeg has ended."""
    try:
        act(*values)
    except OSError:
        return False
    return True


def _explain_failure(process: subprocess.Popen, said: IO[bytes], path: Path, count: int) -> UserError:
    """Return the error to raise after ffmpeg has failed. said: its messages. count: frames that it was given."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(_WAIT)
    said.seek(0)
    lines = said.read().decode("utf-8", "replace").strip().splitlines()
    # Without the part of ffmpeg that says it, "[out#0/mp4 @ 0x5609]".
    reason = re.sub(r"^\[[^\]]*\] ", "", lines[-1]) if lines else f"it ended with {process.returncode}"
    return UserError(
        f"ffmpeg could not write {path}, after {count} frames ({reason}); free space there, or "
        "choose another --size or place"
    )


def _list_arguments(width: int, height: int, fps: int) -> list[str]:
    """List ffmpeg's arguments, without its name and the output, to encode raw RGB frames from its input as H.264."""
    # Exact rounding, and values of colour that lie where H.264 has them: on the left one of two pixels.
    exact = "flags=bicubic+accurate_rnd+full_chroma_int+full_chroma_inp:out_h_chr_pos=0:out_v_chr_pos=128"
    colours = f"scale=in_range=full:out_range=limited:out_color_matrix=bt709:{exact},format=yuv420p"
    # The encoder's own options for this are ignored for all but the matrix.
    colours += ",setparams=range=tv:colorspace=bt709:color_primaries=bt709:color_trc=bt709"
    return [
        *("-y", "-hide_banner", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"),
        *("-video_size", f"{width}x{height}", "-framerate", str(fps), "-i", "pipe:0", "-an", "-vf", colours),
        *("-c:v", "libx264", "-preset", "medium", "-crf", str(CRF), "-pix_fmt", "yuv420p"),
        # The index comes first, so that players on the web begin before they have the whole file.
        *("-movflags", "+faststart", "-f", "mp4"),
    ]
