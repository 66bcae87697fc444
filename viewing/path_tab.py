"""The tab that records a camera path by keyframes."""

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING

from moving_cameras.keyframes import EASINGS, CameraPath, Keyframe
from utils.system_utils import UserError
from viewing.in_turn import in_turn
from viewing.poses import pose_of
from viewing.texts import as_utf8

if TYPE_CHECKING:
    import viser

FOLDER = "camera_paths"  # in the model's folder
_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
_LONGEST = 3600.0  # seconds between keyframes


class PathTab:
    """Controls that add the browser's view as a keyframe, and save the path in the model's folder."""

    def __init__(self, server: "viser.ViserServer", model_path: Path) -> None:
        gui, self._folder = server.gui, Path(model_path) / FOLDER
        self.keyframes: list[Keyframe] = []
        self.seconds = gui.add_number("Seconds to the next", 2.0, min=0.1, max=_LONGEST, step=0.1)
        add, remove = gui.add_button("Add this view"), gui.add_button("Remove the last")
        self.count = gui.add_text("Keyframes", "0", disabled=True)
        self.easing = gui.add_dropdown("Easing", EASINGS)
        self.name = gui.add_text("Name", self._free_name(), hint="letters, digits, - and _")
        save = gui.add_button("Save path")
        add.on_click(in_turn(lambda event: self.add(event.client)))
        remove.on_click(in_turn(lambda _: self.remove()))
        save.on_click(in_turn(lambda event: self._save(event.client)))

    def add(self, client: "viser.ClientHandle") -> None:
        """Append the view of a browser, with what its window shows from top to bottom."""
        pose = pose_of(client.camera)
        if pose is None:
            return
        wait = self.seconds.value if math.isfinite(self.seconds.value) else 0.1
        seconds = self.keyframes[-1].seconds + min(max(wait, 0.1), _LONGEST) if self.keyframes else 0.0
        self.keyframes.append(Keyframe(round(seconds, 3), pose.position, pose.wxyz, math.degrees(pose.fov)))
        self.count.value = str(len(self.keyframes))

    def remove(self) -> None:
        """Remove the last keyframe, if there is one."""
        del self.keyframes[-1:]
        self.count.value = str(len(self.keyframes))

    def save(self, name: str) -> Path:
        """Write the path as camera_paths/NAME.json of the model's folder. UserError for what cannot be written."""
        if not _NAME.fullmatch(name):
            raise UserError("the name of a path has 1 to 64 letters, digits, - and _; choose another one")
        if len(self.keyframes) < 2:
            raise UserError(f"a path needs at least 2 keyframes, this one has {len(self.keyframes)}; add views")
        easing = self.easing.value if self.easing.value in EASINGS else EASINGS[0]
        file = self._folder / f"{name}.json"
        CameraPath(tuple(self.keyframes), easing).write(file)
        return file

    def _save(self, client: "viser.ClientHandle | None") -> None:
        try:
            title, body = "Saved", f"render.py -m {self._folder.parent} --path {self.save(self.name.value)}"
        except UserError as error:
            title, body = "Not saved", str(error)
        if client is not None:
            client.add_notification(title, as_utf8(body))

    def _free_name(self) -> str:
        number = 1
        while (self._folder / f"path{number}.json").exists():
            number += 1
        return f"path{number}"
