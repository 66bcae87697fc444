"""The tab that measures between points that somebody clicks, and sets scale, upright and front right."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from applications.viewer.tabs import Refuse, serialize
from applications.viewer.views import Pose, SceneCameras, read_pose
from groundwork.files.json_files import MODEL_JSON, read_model_json, write_json
from groundwork.files.measured import ground_normal, measured_record
from groundwork.files.similarity import ENTRY, FILE, Similarity, read_orientation, recorded_similarity
from utils.system_utils import UserError

if TYPE_CHECKING:
    import viser

OFF, LENGTH, GROUND, FRONT = TOOLS = ("Nothing", "A length", "The ground", "The front")
_POINTS = {LENGTH: 2, GROUND: 3, FRONT: 2}
_COLOURS = {LENGTH: (255, 200, 0), GROUND: (60, 200, 90), FRONT: (240, 80, 200)}
_SAYS = {
    OFF: "Choose what to click.",
    LENGTH: "Click the two ends of a length.",
    GROUND: "Click three points of the ground, far from each other.",
    FRONT: "Click two points, from left to right, of a line that is to be looked at straight on.",
}
_SIZE, _WIDTH = 0.006, 0.004  # radius of a point and width of a line, by the scene's size

Find = Callable[[Pose, np.ndarray, Callable[[np.ndarray | None], None]], None]


class Place:
    """Files that keep a model's orientation. folder: of the model; scene: its folder, "" without one."""

    def __init__(self, folder: Path, scene: str, offset: tuple[float, float, float]) -> None:
        """Read the records of the scale, upright and front that were set before.

        folder: of the model.
        scene: folder of the scene, "" without one.
        offset: of the world in which the model is shown, (3,).
        """
        self._folder, self._scene, self.offset = folder, scene, np.array(offset, np.float64)
        self.record: dict[str, Any] | None = recorded_similarity(str(folder), scene).get(ENTRY)
        of_scene = read_orientation(Path(scene)) if scene else None
        self._of_scene = bool(scene) and (of_scene is None or of_scene == self.record)
        # Records before each `write`, as `_write_records` takes them.
        self.before: list[tuple[Any, list[tuple[Path, Any]]]] = []

    @property
    def unit(self) -> tuple[float, str]:
        """Return the length of a unit of the scene, and in which unit that length is."""
        known = self.record and Similarity.read(self.record, "orientation")
        return (known.scale, "m") if known and known.metric else (1.0, "units of the scene")

    def write(self, record: dict[str, Any]) -> list[Path]:
        """Keep a record in the model, and where convert.py --orient does unless another one is there; the files."""
        records = [(Path(self._scene) / FILE, read_orientation(Path(self._scene)))] if self._of_scene else []
        if (self._folder / MODEL_JSON).is_file() or not records:
            records.append((self._folder / MODEL_JSON, read_model_json(self._folder).get(ENTRY)))
        self.before.append((self.record, records))
        return self._write_records(record, [(path, record) for path, _ in records])

    def restore(self) -> list[Path]:
        """Put back what the last `write` replaced; the files."""
        return self._write_records(*self.before.pop())

    def _write_records(self, record: dict[str, Any] | None, records: list[tuple[Path, Any]]) -> list[Path]:
        """Write the records of files, None: without one. record: the one that counts from now on."""
        for path, entry in records:
            if path.name == MODEL_JSON:
                others = {name: other for name, other in read_model_json(self._folder).items() if name != ENTRY}
                write_json(path, others if entry is None else others | {ENTRY: entry})
            elif entry is None:
                path.unlink(missing_ok=True)
            else:
                write_json(path, entry)
        self.record = record
        return [path for path, _ in records]


class MeasureTab:
    """Controls for what to click, and points.

    find: calls back with the place of the surface along a ray, or None.
    place: where to keep what was set, None: nowhere.
    report: called with a browser, what was done and the files that were written.
    refuse: called with a browser and a UserError.
    """

    def __init__(
        self,
        server: "viser.ViserServer",
        cameras: SceneCameras,
        find: Find,
        place: Place | None,
        report: Callable[[Any, str, list[Path]], None],
        refuse: Refuse,
    ) -> None:
        """Put the controls into the current tab of the server."""
        gui, self._server, self._cameras, self._find, self._place = server.gui, server, cameras, find, place
        self.points: dict[str, list[np.ndarray]] = {tool: [] for tool in _POINTS}
        self._drawn: list[Any] = []
        self.tool = gui.add_dropdown("Click", TOOLS)
        self.says = gui.add_markdown(_SAYS[OFF])
        hint = "of the length, in metres; 0: not known"
        self.metres = gui.add_number("True length", 0.0, min=0.0, max=1e6, step=0.01, hint=hint)
        clear = gui.add_button("Clear", color="gray")
        self.keep = gui.add_button("Set right", hint="scale, upright and front, for exports", disabled=True)
        self.back = gui.add_button("As before", hint="take the last “Set right” back", color="gray", disabled=True)
        self.tool.on_update(serialize(lambda _: self._choose()))
        self.metres.on_update(serialize(lambda _: self._show()))
        clear.on_click(serialize(lambda _: self._clear_points()))
        self.keep.on_click(serialize(lambda event: report(event.client, "Set right", self.write()), refuse))
        self.back.on_click(serialize(lambda event: report(event.client, "As before", self.restore()), refuse))

    def _choose(self) -> None:
        """Listen to clicks while there is something to click."""
        self._server.scene.remove_click_callback("all")
        if self.tool.value != OFF:
            self._server.scene.on_click()(self._take_click)
        self._show()

    async def _take_click(self, event: Any) -> None:
        pose, tool = read_pose(event.client.camera), self.tool.value
        if pose is not None and tool in _POINTS:
            self._find(pose, np.array(event.ray_direction), lambda point: self.add(tool, point))

    def add(self, tool: str, point: np.ndarray | None) -> None:
        """Take a point (3,); a full tool begins anew. None: nothing is there."""
        if point is None:
            self.says.content = "There is no surface; click another point."
            return
        points = self.points[tool]
        self.points[tool] = [*points, point] if len(points) < _POINTS[tool] else [point]
        self._show()

    def _clear_points(self) -> None:
        self.points = {tool: [] for tool in _POINTS}
        self._show()

    def _find_complete_points(self, tool: str) -> np.ndarray | None:
        """Return the points (P, 3) that were clicked for a tool; None until there are as many as it needs."""
        return np.array(self.points[tool]) if len(self.points[tool]) == _POINTS[tool] else None

    @property
    def length(self) -> float | None:
        """Return the distance of the two points, in the scene's unit; None without them."""
        ends = self._find_complete_points(LENGTH)
        return None if ends is None else float(np.linalg.norm(ends[1] - ends[0]))

    def _show(self) -> None:
        """Draw the points, and say what they measure."""
        for drawn in self._drawn:
            drawn.remove()
        self._drawn, scene, size = [], self._server.scene, self._cameras.size
        for tool, points in self.points.items():
            for number, point in enumerate(points):
                name, look = f"/measured/{tool}/{number}", {"color": _COLOURS[tool], "position": point}
                self._drawn.append(scene.add_icosphere(name, _SIZE * size, subdivisions=1, **look))
            if len(points) > 1:
                ends = np.stack([points, points[1:] + points[:1]], axis=1)[: len(points) if len(points) > 2 else 1]
                lines = f"/measured/{tool}/lines", ends.astype(np.float32), _COLOURS[tool]
                self._drawn.append(scene.add_line_segments(*lines, thickness=_WIDTH * size))
        scale, unit = self._place.unit if self._place else (1.0, "units")
        self.says.content = _SAYS[self.tool.value]
        if self.length is not None:
            said = f"{self.length * scale:.4g} {unit}"
            self.says.content = f"The length is {said}. {self.says.content}"
            self._drawn.append(scene.add_label("/measured/length", said, position=np.mean(self.points[LENGTH], axis=0)))
        if (ground := self._find_complete_points(GROUND)) is not None:
            tilt = f"The ground is tilted by {self._measure_tilt(ground):.1f} degrees in the photos."
            self.says.content = f"{tilt} {self.says.content}"
        known = (self.length or 0) > 0 and self.metres.value > 0
        whole = known or any(self._find_complete_points(tool) is not None for tool in (GROUND, FRONT))
        self.keep.disabled = self._place is None or not whole
        self.back.disabled = not (self._place and self._place.before)

    def _measure_tilt(self, ground: np.ndarray) -> float:
        """Degrees between what is up for the ground (3,3) and for the photos."""
        normal = ground_normal(ground)
        cosine = abs(normal @ self._cameras.vertical) / np.linalg.norm(normal).clip(1e-12)
        return math.degrees(math.acos(min(1.0, cosine)))

    def write(self) -> list[Path]:
        """Keep what was measured; the files. UserError for what cannot be kept."""
        if self._place is None or self.keep.disabled:
            raise UserError("there is nothing to set right; click the ground, the front, or a length that you know")
        metres = self.metres.value if math.isfinite(self.metres.value) else 0.0
        scale = metres / self.length if self.length and metres > 0 else None
        moved = {
            tool: None if (it := self._find_complete_points(tool)) is None else it + self._place.offset
            for tool in _POINTS
        }
        above = self._cameras.middle + self._place.offset
        record = measured_record(self._place.record, above, scale, moved[GROUND], moved[FRONT])
        Similarity.read(record, "what was measured")  # a scale that no scene has
        files = self._place.write(record)
        self._show()
        return files

    def restore(self) -> list[Path]:
        """Take the last `write` back; the files. UserError without one."""
        if self.back.disabled:
            raise UserError("nothing was set right since this page began; press “Set right” first")
        files = self._place.restore()
        self._show()
        return files
