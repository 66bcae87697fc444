"""What the page says of a training's length, and a training that begins paused."""

import threading
from types import SimpleNamespace

import pytest

pytest.importorskip("viser", reason="viser is not installed: pip install '.[viewer]'")

from waiting import wait_for  # noqa: E402

import train  # noqa: E402
from splatting.parts.viewer import training_page  # noqa: E402
from splatting.viewer.training_tab import time_left  # noqa: E402
from utils.system_utils import UserError  # noqa: E402


def test_the_time_left_is_in_seconds_then_in_minutes():
    assert [time_left(s) for s in (None, 0.0, 0.2, 99, 100)] == ["", "0 s to go", "1 s to go", "99 s to go",
                                                                 "2 min to go"]  # fmt: skip
    assert time_left(90_000) == "1,500 min to go"


def test_the_time_left_is_that_of_the_budget_where_one_is_given():
    def left(seconds: float, speed: float | None, expected: float | None = 7000) -> float | None:
        schedule = SimpleNamespace(seconds=seconds, expected=expected)
        page = SimpleNamespace(_run=SimpleNamespace(schedule=schedule, clock=SimpleNamespace(seconds=4.0)))
        return training_page.TrainingPage._seconds_left(page, 1200, speed)

    assert left(0.0, 100.0) == 58 and left(10.0, 100.0) == 6 and left(3.0, None) == 0
    assert left(0.0, None) is None and left(0.0, 100.0, None) is None


def test_a_paused_training_waits_after_its_first_iteration(colmap_scene, tmp_path, monkeypatch):
    pages = []

    class Page(training_page.TrainingPage):
        def __init__(self, *given: object) -> None:
            super().__init__(*given)
            pages.append(self)

    def resume() -> None:
        wait_for(lambda: pages and pages[0]._page.iteration.value == "1 of 30")
        seen.append(pages[0]._tab.pause.label)
        pages[0]._tab.turn()

    seen: list[str] = []
    monkeypatch.setattr(training_page, "TrainingPage", Page)
    monkeypatch.setattr(training_page, "serve", lambda page: None)
    threading.Thread(target=resume).start()
    words = ["-s", colmap_scene, "-m", tmp_path / "out", "--iterations", 30, "--viewer", 0, "--paused"]
    train.main([*map(str, words)])
    assert seen == ["Resume"] and pages[0]._page.iteration.value == "30" and pages[0]._tab.left.value == ""


def test_paused_without_a_page_is_refused(colmap_scene, tmp_path):
    with pytest.raises(UserError, match="add --viewer"):
        train.main(["-s", str(colmap_scene), "-m", str(tmp_path / "out"), "--paused"])
    assert not (tmp_path / "out").exists()
