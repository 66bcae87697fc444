"""The tab of a camera path: keyframes that are recorded, listed, deleted, played, saved and opened."""

import asyncio
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from applications.viewer.tabs import FileName, Refuse, serialize
from applications.viewer.views import SceneCameras, read_pose
from gaussian_renderer.camera_paths.keyframes import EASINGS, CameraPath, Keyframe, KeyframePath, read_camera_path
from gaussian_renderer.free_view import rotation_matrix
from utils.system_utils import UserError

if TYPE_CHECKING:
    import viser

_LONGEST_WAIT = 3600.0  # seconds between keyframes
_MOST = 200  # keyframes
_BETWEEN = 1 / 30  # seconds from pose to pose of a path that is played
_NONE = "none yet"


class PathTab:
    """Controls that record the browser's view as a keyframe, go to one or delete it, and play, save and open a path.

    folder: for the files of paths. refuse: called with a browser and a UserError.
    """

    def __init__(self, server: "viser.ViserServer", folder: Path, cameras: SceneCameras, refuse: Refuse) -> None:
        """Put the controls into the current tab of the server. folder: of the model, for saved paths."""
        gui, self._server, self._cameras = server.gui, server, cameras
        self.keyframes: list[Keyframe] = []
        self._playing: asyncio.Task | None = None
        self.seconds = gui.add_number("Seconds from previous keyframe", 2.0, min=0.1, max=_LONGEST_WAIT, step=0.1)
        add = gui.add_button("Add this view")
        self.chosen = gui.add_dropdown("Keyframes", (_NONE,), hint="the view jumps there")
        again = gui.add_button("Go to the keyframe")
        delete = gui.add_button("Delete the keyframe", hint="the others keep their times, from 0 s of the first one")
        self.easing = gui.add_dropdown("Easing", EASINGS)
        self.play = gui.add_button("Play", hint="moves the view along the path, as its video does")
        self.file = FileName(server, folder, "path", ".json")
        self.saved = gui.add_button("Save the path")
        self.files = gui.add_dropdown("Saved paths", (_NONE,))
        opened = gui.add_button("Open the path", hint="in place of the keyframes above")
        self.chosen.on_update(serialize(lambda event: self.move_to_keyframe(event.client), refuse))
        buttons, calls = (
            (add, again, delete, self.play, opened),
            (self.add, self.move_to_keyframe, self.delete, self.toggle_playing, self.open),
        )
        for button, call in zip(buttons, calls, strict=True):
            button.on_click(serialize(lambda event, call=call: call(event.client), refuse))
        self._of_one, self._of_two, self._of_file = (again, delete), (self.play, self.saved), opened
        self._update_buttons()
        self.list_files()

    def _update_buttons(self) -> None:
        """Let nobody press what needs keyframes that are not there."""
        for least, buttons in ((1, self._of_one), (2, self._of_two)):
            for button in buttons:
                button.disabled = len(self.keyframes) < least

    def add(self, client: "viser.ClientHandle") -> None:
        """Append the view of a browser, with what its window shows from top to bottom, if there is room for it."""
        pose = read_pose(client.camera)
        if pose is None:
            return
        if len(self.keyframes) >= _MOST:
            raise UserError(f"a path has at most {_MOST} keyframes here; delete one first")
        wait = min(max(self.seconds.value, 0.1), _LONGEST_WAIT)
        seconds = self.keyframes[-1].seconds + wait if self.keyframes else 0.0
        self.keyframes.append(Keyframe(round(seconds, 3), pose.position, pose.wxyz, math.degrees(pose.fov)))
        self._list_keyframes(len(self.keyframes) - 1)

    def delete(self, client: "viser.ClientHandle") -> None:
        """Delete the chosen keyframe, and go to the one in its place.

        The others keep their times; if it was the first one, they all move, since a path begins at 0.
        """
        index = self._find_index()
        del self.keyframes[index]
        first = self.keyframes[0].seconds if self.keyframes else 0.0
        self.keyframes = [replace(key, seconds=round(key.seconds - first, 3)) for key in self.keyframes]
        self._list_keyframes(min(index, len(self.keyframes) - 1))
        self.move_to_keyframe(client if self.keyframes else None)

    def _list_keyframes(self, index: int) -> None:
        """List the keyframes, and choose one."""
        names = tuple(f"{n}: at {key.seconds:g} s" for n, key in enumerate(self.keyframes, 1)) or (_NONE,)
        self.chosen.options = names
        self.chosen.value = names[max(index, 0)]
        self._update_buttons()

    def _find_index(self) -> int:
        if not self.keyframes or self.chosen.value not in self.chosen.options:
            raise UserError("no keyframe is chosen; add a view, or choose one of the list")
        return self.chosen.options.index(self.chosen.value)

    def move_to_keyframe(self, client: "viser.ClientHandle | None") -> None:
        """Move a browser's camera to the chosen keyframe. None: the list has changed by itself."""
        if client is not None:
            self._move_view(client, self.keyframes[self._find_index()])

    def _move_view(self, client: "viser.ClientHandle", key: Keyframe) -> None:
        self._cameras.move(client, np.array(key.position), rotation_matrix(key.wxyz), math.radians(key.fov))

    def toggle_playing(self, client: "viser.ClientHandle") -> None:
        """Move a browser's camera along the path in real time, or stop if that is under way."""
        if self._playing is not None:
            return self.stop()
        self._playing = asyncio.get_running_loop().create_task(self._play_path(client, KeyframePath(self.path())))
        self._playing.add_done_callback(self._end_playing)
        self.play.label = "Stop"

    def stop(self) -> None:
        """Stop playing. May be called from any thread."""
        if playing := self._playing:
            playing.get_loop().call_soon_threadsafe(playing.cancel)

    async def _play_path(self, client: "viser.ClientHandle", path: KeyframePath) -> None:
        """Move a browser's view along the path, until its end or until the browser leaves."""
        began, seconds = time.perf_counter(), -1.0
        while seconds < path.seconds and client.client_id in self._server.get_clients():
            seconds = min(time.perf_counter() - began, path.seconds)
            self._move_view(client, path.at(seconds))
            await asyncio.sleep(_BETWEEN)

    def _end_playing(self, _: asyncio.Task) -> None:
        self._playing, self.play.label = None, "Play"

    def path(self) -> CameraPath:
        """The path of the keyframes. UserError without two of them."""
        if len(self.keyframes) < 2:
            raise UserError(f"a path needs at least 2 keyframes, this one has {len(self.keyframes)}; add views")
        easing = self.easing.value if self.easing.value in EASINGS else EASINGS[0]
        return CameraPath(tuple(self.keyframes), easing)

    def save(self) -> Path:
        """Write the path and return its file. UserError for what cannot be written."""
        file = self.file.path()
        self.path().write(file)
        self.list_files()
        return file

    def list_files(self) -> None:
        """List the saved paths."""
        names = self.file.names()
        self.files.options, self._of_file.disabled = names or (_NONE,), not names

    def open(self, client: "viser.ClientHandle") -> None:
        """Take the keyframes of the chosen file, and go to the first one. UserError for what is no such file."""
        name = self.files.value
        if name not in self.file.names():
            raise UserError("there is no such path; save one first, or choose one of the list")
        self.file.field.value, path = name, read_camera_path(self.file.folder / f"{name}.json")
        self.keyframes, self.easing.value = list(path.keyframes), path.easing
        self._list_keyframes(0)
        self.move_to_keyframe(client)
