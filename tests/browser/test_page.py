"""The viewer's page in a real browser, while a training runs on the CPU in another process."""

import io
import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from served_page import labelled, serving
from synthetic import make_colmap_scene
from tab_pictures import until

pytest.importorskip("viser", reason="viser is not installed: pip install '.[viewer]'")
pytestmark = pytest.mark.browser
PICTURE = 900, 600
WINDOW = PICTURE[0] + 324, PICTURE[1]  # with the controls beside the picture


@pytest.fixture(scope="module")
def training(tmp_path_factory) -> Iterator[tuple[str, Path]]:
    """A training in another process: the address of its page, and its scene."""
    folder = tmp_path_factory.mktemp("page")
    make_colmap_scene(folder / "scene")
    words = ["-s", folder / "scene", "-m", folder / "out", "--eval", "--viewer", 0, "--iterations", 30_000]
    with serving("train.py", *words) as (address, process):
        # Read on, so that the progress bar never waits for a reader.
        threading.Thread(target=process.stderr.read, daemon=True).start()
        yield address, folder / "scene"


def _number(tab, label: str) -> float:
    return float(labelled(tab, label).input_value().split(" of ")[0].replace(",", "") or "nan")


def _paused_at(tab) -> float:
    """The iteration at which the training waits; NaN while it takes one."""
    return _number(tab, "Iteration") if labelled(tab, "Iteration").input_value().endswith("paused") else float("nan")


def _picture(tab) -> np.ndarray:
    """The left part of the picture that the tab shows, (600, 525, 3)."""
    shot = tab.screenshot(clip={"x": 0, "y": 0, "width": 525, "height": 600})
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(float)


def _open(tab, address: str) -> None:
    tab.goto(address)
    tab.get_by_role("tab", name="View").wait_for()
    notice = tab.get_by_role("alert").get_by_role("button")  # that WebGL is slow here
    notice.first.click()
    until(lambda: _picture(tab)[150:].std() > 15, "the page shows no picture")


def test_the_page_loads_and_moves(tab, training):
    _open(tab, training[0])
    before = _picture(tab)
    tab.mouse.move(300, 400)
    tab.mouse.down()
    for step in range(1, 6):
        tab.mouse.move(300 + 40 * step, 400)
    tab.mouse.up()
    until(lambda: abs(_picture(tab) - before).mean() > 8, "the picture does not follow the mouse")


def test_the_training_pauses_and_resumes_and_its_curve_is_drawn(tab, training):
    _open(tab, training[0])
    tab.get_by_role("tab", name="Training").click()
    tab.locator(".uplot canvas").wait_for()
    tab.get_by_role("button", name="Pause").click()
    tab.get_by_role("button", name="Resume").wait_for()
    until(lambda: _paused_at(tab) > 0, "the training does not pause")
    paused = _paused_at(tab)
    tab.get_by_role("button", name="One step").click()
    until(lambda: _paused_at(tab) == paused + 1, "no step was taken")
    tab.get_by_role("button", name="Resume").click()
    until(lambda: _number(tab, "Iteration") > paused + 1, "the training does not resume")
    assert _number(tab, "Loss") > 0 and _number(tab, "Gaussians") > 0


def _type(tab, label: str, text: str) -> None:
    """Type a text, and again where the field falls back to its value before: it does if it is drawn anew meanwhile."""
    field = labelled(tab, label)

    def holds() -> bool:
        field.fill(text)
        field.press("Enter")
        time.sleep(0.3)
        return field.input_value() == text

    until(holds, f"{label} does not take {text}")


def test_every_kind_of_control_is_heard(tab, training):
    address, scene = training
    _open(tab, address)
    tab.get_by_role("tab", name="Path").click()
    _type(tab, "Seconds from previous keyframe", "3")
    _type(tab, "Name", "typed")
    keyframes = tab.get_by_role("combobox", name="Keyframes")
    for listed in ("1: at 0 s", "2: at 3 s"):
        tab.get_by_role("button", name="Add this view").click()
        until(lambda listed=listed: keyframes.input_value() == listed, "no keyframe was added")
    keyframes.click()
    tab.get_by_role("option", name="1: at 0 s").click()
    tab.get_by_role("button", name="Save the path").click()
    path = scene.parent / "out/camera_paths/typed.json"
    until(path.is_file, "the path was not saved")
    assert [keyframe["seconds"] for keyframe in json.loads(path.read_text())["keyframes"]] == [0, 3]
    tab.get_by_role("button", name="Play").click()
    tab.get_by_role("button", name="Stop", exact=True).wait_for()
    tab.get_by_role("button", name="Play").wait_for()
    tab.get_by_role("tab", name="View").click()
    assert not tab.get_by_text("Scaling modifier").is_visible()
    tab.get_by_role("button", name="Advanced").or_(tab.get_by_text("Advanced")).first.click()
    tab.get_by_text("Scaling modifier").wait_for()
    tab.get_by_role("checkbox", name="Crop box").click()
    _type(tab, "x from, to", "900")
    _type(tab, "Background", "rgb(250, 0, 0)")
    # Now the box is beside the Gaussians, and what is outside of it is not drawn.
    red = np.array([250, 0, 0])
    until(lambda: abs(np.median(_picture(tab)[150:], (0, 1)) - red).max() < 5, "the crop box was not heard")
    tab.get_by_role("button", name="Reset").click()
    until(lambda: labelled(tab, "Background").input_value() == "rgb(0, 0, 0)", "the background stays")


def test_the_line_between_photo_and_render_is_dragged_and_the_camera_stays(tab, training):
    _open(tab, training[0])
    tab.get_by_role("tab", name="Photos").click()
    tab.get_by_role("combobox", name="Compare").click()
    tab.get_by_role("option", name="Slider").click()
    tab.get_by_text("Photo left of the line").wait_for()
    share, (x, y) = labelled(tab, "Slider"), (PICTURE[0] / 2, PICTURE[1] / 2)

    def dragged() -> bool:
        """Go to the camera and drag; tell whether the line has followed. Before the line is drawn, the camera turns."""
        tab.get_by_role("button", name="Go to the camera").click()
        tab.mouse.move(x, y)
        tab.mouse.down()
        for step in range(1, 11):
            tab.mouse.move(x - 20 * step, y)
            time.sleep(0.05)
        tab.mouse.up()
        time.sleep(1)
        return float(share.input_value()) < 0.45

    until(dragged, "the line does not follow the mouse")
    assert tab.get_by_text("Photo left of the line").is_visible()
    tab.mouse.move(x + 300, y)
    tab.mouse.down()
    tab.mouse.move(x + 300, y - 60, steps=4)
    tab.mouse.up()
    tab.get_by_text("No photo was taken from here").wait_for()
