"""The page of full_eval.py's report in a real browser: its size, what is read on it, and its pictures."""

import io
import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image
from report_runs import set_runs

from applications.evaluation.report import make_report, write_report

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = pytest.mark.browser
WINDOW = 1280, 720
OPEN = "document.querySelectorAll('details').forEach((it) => it.open = true)"
SCREENS = """() => {  // heights of the scenes' sections, in screens
  const tops = [...document.querySelectorAll("h2")].map((it) => it.getBoundingClientRect().top);
  return tops.slice(2).map((top, index) => (top - tops[index + 1]) / window.innerHeight);
}"""
RED, BLUE = (200, 0, 0), (0, 0, 200)
SHARES = """() => {  // the parts of the page, in pixels, that show photo, render and error
  const area = (name) => [...document.querySelectorAll(name)].filter((it) => it.checkVisibility())
    .map((it) => it.getBoundingClientRect()).reduce((sum, box) => sum + box.width * box.height, 0);
  return [".views > :first-child img", ".both", ".error img"].map(area);
}"""


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> Path:
    """A report of 2 scenes, 3 option sets and 2 seeds, with five portrait test views: red photos and blue renders."""
    out = tmp_path_factory.mktemp("report")
    runs = [run for scene in ("attic", "brick") for run in set_runs(scene)]
    for run in runs:
        run |= {"worst_views": [{"file": "00000.png"}], "lines": ["A long line about the end of a training " * 3]}
        run["peak"] = {"iteration": 20, "test_psnr": 31.0, "lost": 0.4, "gained": 1.2, "shorter_ends_there": True}
        run["machine"] = {"cpu": "a CPU", "gpu": None, "instruction_set": "avx2", "threads": 2, "commit": "abc"}
        run["machine"] |= {"python": "3.11", "packages": {"torch": "2"}}
        run["iterations"][str(run["final_iteration"])] |= {"SSIM": 0.9, "process_seconds": 9.0, "cpu_seconds": 9.0}
        run["curve"] = [row | {"test_ssim": row["test_psnr"] / 40, "subset": None} for row in run["curve"]]
        model = out / run["model"]
        names = [f"{view:05d}.png" for view in range(5)]
        for side, colour in (("gt", RED), ("renders", BLUE)):
            (model / "test" / "ours_30" / side).mkdir(parents=True)
            for name in names:
                Image.new("RGB", (270, 480), colour).save(model / "test" / "ours_30" / side / name)
        scores = {"ours_30": {"PSNR": 20.0, "SSIM": 0.9}}
        photos = [{"img_name": f"{'a_long_name_without_a_break_' * 3}{name}"} for name in names]
        (model / "cameras.json").write_text(json.dumps(photos))
        (model / "results.json").write_text(json.dumps(scores))
        each = {name: dict.fromkeys(names, value) for name, value in scores["ours_30"].items()}
        (model / "per_view.json").write_text(json.dumps({"ours_30": each}))
    write_report(make_report(["full_eval.py", "--scenes", "attic", "brick"], runs), out)
    return out / "report.html"


@pytest.mark.parametrize(("width", "height", "screens"), [(1280, 720, 3), (390, 844, 3)])
def test_each_scene_fills_a_screen_and_nothing_overflows(tab, report, width, height, screens):
    tab.set_viewport_size({"width": width, "height": height})
    tab.goto(report.as_uri())
    assert tab.evaluate("document.documentElement.scrollHeight") <= screens * height
    assert max(tab.evaluate(SCREENS)) <= 1
    assert tab.evaluate("document.documentElement.scrollWidth") == width
    assert tab.locator(".comparison:visible").count() == 0
    tab.evaluate(OPEN)
    assert tab.evaluate("document.documentElement.scrollWidth") == width
    assert tab.locator(".comparison:visible").count() == 2 * 5
    lines = """() => [...document.querySelectorAll("td, th")].map((cell) => {
      const range = document.createRange();
      range.selectNodeContents(cell);
      return range.getBoundingClientRect().height / parseFloat(getComputedStyle(cell).lineHeight);
    })"""
    assert max(tab.evaluate(lines)) < 2.5  # no cell is broken into three lines
    figures = tab.locator(".figures img").all()
    assert len(figures) == 2 * 3 and min(figure.bounding_box()["width"] for figure in figures) > 330


def test_the_option_sets_lie_side_by_side_for_the_same_view(tab, report):
    show(tab, report)
    boxes = [
        it.bounding_box()
        for it in tab.locator("figure.comparison").first.locator(".views > :first-child img, .both").all()
    ]
    assert len(boxes) == 4 and len({box["y"] for box in boxes}) == 1 and len({box["height"] for box in boxes}) == 1
    photo, renders, errors = tab.evaluate(SHARES)
    assert renders == pytest.approx(3 * photo, rel=0.01) and errors == 0
    tab.get_by_label("Show the errors").first.check()
    assert tab.evaluate(SHARES) == pytest.approx([photo, 0, renders], rel=0.01)


def show(tab: "Page", report: Path) -> None:
    tab.goto(report.as_uri())
    tab.get_by_text("Pictures of all 5 test views").first.click()


def colours(tab: "Page") -> list[float]:
    """Parts of the first render's place that show photo and render."""
    shot = tab.locator(".both").first.screenshot()
    shown = np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"))
    return [float((shown[..., channel] > 150)[shown.min(axis=2) < 50].mean()) for channel in (0, 2)]


def test_the_slider_moves_between_photo_and_render(tab, report):
    show(tab, report)
    slider = tab.locator(".both input").first
    assert colours(tab) == pytest.approx([0, 1], abs=0.03)  # the renders are compared first
    box = slider.bounding_box()
    tab.mouse.move(box["x"] + 2, box["y"] + box["height"] / 2)
    tab.mouse.down()
    tab.mouse.move(box["x"] + 0.6 * box["width"], box["y"] + box["height"] / 2)
    tab.mouse.up()
    assert colours(tab) == pytest.approx([0.6, 0.4], abs=0.07)
    slider.press("Home")
    assert colours(tab) == pytest.approx([0, 1], abs=0.03)
