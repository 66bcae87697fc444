"""Pages before a training and at its beginning, in a real browser, on a screen and on a phone."""

import signal

import pytest
from served_page import labelled, serving
from synthetic import make_colmap_scene
from tab_pictures import until

pytest.importorskip("viser", reason="viser is not installed: pip install '.[viewer]'")
pytestmark = pytest.mark.browser
WINDOW = 1280, 720
SIZES = (1280, 720), (390, 844)


def test_a_paused_training_says_its_length_and_ends_by_a_signal(tab, tmp_path):
    make_colmap_scene(tmp_path / "attic")
    words = "-s", tmp_path / "attic", "-m", tmp_path / "out", "--iterations", 7000, "--viewer", 0, "--paused"
    with serving("train.py", *words) as (address, process):
        for width, height in SIZES:
            tab.set_viewport_size({"width": width, "height": height})
            tab.goto(address)
            tab.get_by_role("tab", name="Training").click()
            assert tab.title() == "out"
            tab.get_by_role("button", name="Resume").wait_for()
            iteration = labelled(tab, "Iteration")
            until(lambda it=iteration: it.input_value() == "1 of 7,000, paused", "the training does not wait")
        tab.get_by_role("button", name="Resume").click()
        tab.wait_for_function(
            r"[...document.querySelectorAll('input')].some((it) => /^(\d+ \w+ )?\d+ (s|min)$/.test(it.value))"
        )
        tab.get_by_role("button", name="Pause").click()
        process.send_signal(signal.SIGINT)
        said = process.communicate(timeout=60)[1]
        assert process.returncode == 130 and "Traceback" not in said
        assert list((tmp_path / "out").glob("chkpnt*.pth"))
        tab.goto("about:blank")
