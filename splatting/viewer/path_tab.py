"""The tab of a camera path: keyframes that are recorded, listed, deleted and saved."""

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gaussian_renderer.free_view import rotation_matrix
from splatting.camera_paths.keyframes import EASINGS, CameraPath, Keyframe
from splatting.viewer.tabs import FileName, serialized
from splatting.viewer.views import SceneCameras, pose_of
from utils.system_utils import UserError

if TYPE_CHECKING:
    import viser

_LONGEST_WAIT = 3600.0  # seconds between keyframes
_MOST = 200  # keyframes
_NONE = "none yet"


class PathTab:
    """Controls that record the browser's view as a keyframe, go to one or delete it, and save the path.

    folder: for the files of paths.
    """

    def __init__(self, server: "viser.ViserServer", folder: Path, cameras: SceneCameras) -> None:
        gui, self._cameras = server.gui, cameras
        self.keyframes: list[Keyframe] = []
        self.seconds = gui.add_number("Seconds to next keyframe", 2.0, min=0.1, max=_LONGEST_WAIT, step=0.1)
        add = gui.add_button("Add this view")
        self.chosen = gui.add_dropdown("Keyframes", (_NONE,), hint="the view jumps there")
        again, delete = gui.add_button("Go to the keyframe"), gui.add_button("Delete the keyframe")
        self.easing = gui.add_dropdown("Easing", EASINGS)
        self.file = FileName(server, folder, "path", ".json")
        self.saved = gui.add_button("Save the path")
        add.on_click(serialized(lambda event: self.add(event.client)))
        for control in (self.chosen.on_update, again.on_click):
            control(serialized(lambda event: self.go(event.client)))
        delete.on_click(serialized(lambda _: self.delete()))

    def add(self, client: "viser.ClientHandle") -> None:
        """Append the view of a browser, with what its window shows from top to bottom, if there is room for it."""
        pose = pose_of(client.camera)
        if pose is None or len(self.keyframes) == _MOST:
            return
        wait = min(max(self.seconds.value, 0.1), _LONGEST_WAIT)
        seconds = self.keyframes[-1].seconds + wait if self.keyframes else 0.0
        self.keyframes.append(Keyframe(round(seconds, 3), pose.position, pose.wxyz, math.degrees(pose.fov)))
        self._list(len(self.keyframes) - 1)

    def delete(self) -> None:
        """Delete the chosen keyframe. The others keep their times, from that of the first one."""
        index = self._index()
        if index is not None:
            del self.keyframes[index]
            first = self.keyframes[0].seconds if self.keyframes else 0.0
            self.keyframes = [replace(key, seconds=round(key.seconds - first, 3)) for key in self.keyframes]
            self._list(min(index, len(self.keyframes) - 1))

    def _list(self, index: int) -> None:
        """List the keyframes, and choose one."""
        names = tuple(f"{n}: at {key.seconds:g} s" for n, key in enumerate(self.keyframes, 1)) or (_NONE,)
        self.chosen.options = names
        self.chosen.value = names[max(index, 0)]

    def _index(self) -> int | None:
        names, name = self.chosen.options, self.chosen.value
        return names.index(name) if self.keyframes and name in names else None

    def go(self, client: "viser.ClientHandle | None") -> None:
        """Move a browser's camera to the chosen keyframe, if there is one."""
        index = self._index()
        if client is not None and index is not None:
            key = self.keyframes[index]
            place = np.array(key.position)
            self._cameras.move(client, place, rotation_matrix(key.wxyz), math.radians(key.fov))

    def save(self) -> Path:
        """Write the path and return its file. UserError for what cannot be written."""
        file = self.file.path()
        if len(self.keyframes) < 2:
            raise UserError(f"a path needs at least 2 keyframes, this one has {len(self.keyframes)}; add views")
        easing = self.easing.value if self.easing.value in EASINGS else EASINGS[0]
        CameraPath(tuple(self.keyframes), easing).write(file)
        return file
