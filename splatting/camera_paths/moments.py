"""Paths as a pose for each moment: what generated paths and keyframe files have in common."""

from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from splatting.camera_paths.keyframes import CameraPath, Keyframe
from splatting.camera_paths.poses import to_wxyz


class TimedPath(Protocol):
    """A camera in motion. seconds: how long. closed: whether it ends in the pose that it began with."""

    seconds: float
    closed: bool

    def at(self, seconds: float) -> Keyframe:
        """The pose at a moment between 0 and `seconds`."""


def frame_count(path: TimedPath, fps: int) -> int:
    """Frames of a video: round(seconds * fps), and one more for the end of a path that is not closed.

    Frame i shows the moment i / fps. A closed path is shown without its end, which is its beginning, so that the video
    can be played in a loop.
    """
    return max(1, round(path.seconds * fps) + (not path.closed))


def frame_moment(path: TimedPath, fps: int, frame: int) -> float:
    """The moment that a frame shows, in seconds from the path's start."""
    return min(frame / fps, path.seconds)


class KeyframePath:
    """A camera that goes from keyframe to keyframe.

    Positions on straight lines, turns the short way about one axis (Shoemake, SIGGRAPH 1985: slerp), opening angles in
    proportion; with the easing "smooth" by the polynomial 3 u^2 - 2 u^3, which stands still at each keyframe.
    """

    closed = False

    def __init__(self, path: CameraPath) -> None:
        self.seconds = path.seconds
        self._smooth = path.easing == "smooth"
        self._moments = np.array([key.seconds for key in path.keyframes])
        self._rows = np.array([[*key.position, key.fov] for key in path.keyframes])
        self._turns = Rotation.from_quat(np.array([np.roll(key.wxyz, -1) for key in path.keyframes]))
        # In keyframes, not in seconds: neighbours may be nearer in time than Slerp can divide by.
        self._slerp = Slerp(np.arange(len(self._turns)), self._turns)

    def at(self, seconds: float) -> Keyframe:
        """The pose at a moment between 0 and `seconds`."""
        before = int(np.searchsorted(self._moments, seconds, side="right") - 1)
        before = min(max(before, 0), len(self._moments) - 2)
        start, end = self._moments[before : before + 2]
        share = min(max((seconds - start) / (end - start), 0.0), 1.0)
        if self._smooth:
            share *= share * (3 - 2 * share)
        row = self._rows[before] * (1 - share) + self._rows[before + 1] * share
        turn = self._slerp(before + share)
        return Keyframe(seconds, tuple(row[:3].tolist()), tuple(to_wxyz(turn).tolist()), float(row[3]))
