"""Tables and the figure of strategies, from made-up trainings."""

import math

import pytest

from benchmarks.strategies.figure import draw
from benchmarks.strategies.tables import at, joined
from utils.system_utils import UserError


def _run(*points: tuple[float, float], whole: bool = True) -> dict:
    """A training with a curve of seconds and PSNR."""
    curve = [{"iteration": 1, "seconds": x, "gaussians": 9, "test_psnr": y, "whole": whole} for x, y in points]
    return {"end": curve[-1], "curve": curve, "ply_bytes": 1}


def _file(sets: dict[str, dict[str, dict | None]], scene: str = "a", **options: list[str]) -> dict:
    return {"machine": "m", "sets": {name: [] for name in sets} | options, "scenes": {scene: sets}}


def test_a_curve_between_its_points():
    curve = [*_run((1, 20), (3, 24))["curve"], *_run((2, 99), whole=False)["curve"]]
    assert at(curve, 0.5) == -math.inf
    assert at(curve, 2) == pytest.approx(22)
    assert at(curve, 9) == 24


def test_a_training_that_failed_replaces_none_that_ended():
    ended = _file({"adc": {"0": _run((1, 20)), "1": None}})
    failed = _file({"adc": {"0": None, "1": _run((1, 21))}})
    for files in ([ended, failed], [failed, ended]):
        found = joined(files)["scenes"]["a"]["adc"]
        assert {seed: run["end"]["test_psnr"] for seed, run in found.items()} == {"0": 20, "1": 21}


def test_sets_of_one_name_with_other_options_are_refused():
    with pytest.raises(UserError, match="set adc has other options"):
        joined([_file({"adc": {}}), _file({"adc": {}}, adc=["--iterations", "7000"])])


def test_a_figure_of_whatever_trainings_there_are(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        "matplotlib.figure.Figure.savefig", lambda figure, path, **_: drawn.append(figure) or path.touch()
    )
    many = {f"set{number}": {"0": _run((1, 20), (5, 20 + number))} for number in range(11)}
    clock = {"5s": {"0": _run((5, 30)), "1": _run((5, 31))}, "9s": {"0": None}}
    files = [
        _file(many | clock, **dict.fromkeys(clock, ["--strategy", "mcmc", "--time_budget", "5"])),
        _file({"set0": {"0": _run((2, 18))}, "set1": {"0": _run((2, 18), whole=False)}}, "b"),
        _file({"set0": {"0": None}}, "nothing"),
        _file({"set0": {"0": _run((1, 10), (2, 11)), "1": _run((4, 10), (5, 11))}}, "c"),  # at no time both
    ]
    draw(joined(files), tmp_path / "figure.png", ["set10"])
    panels = drawn[0].axes
    assert [panel.get_title() for panel in panels] == ["a", "b", "c", ""]
    assert panels[0].get_legend_handles_labels()[1] == [*(f"set{number}" for number in range(10)), "mcmc by the clock"]
    assert panels[1].get_legend_handles_labels()[1] == ["set0"]
    assert (tmp_path / "figure.png").exists()


def test_a_figure_of_nothing_is_refused(tmp_path):
    with pytest.raises(UserError, match="no training is left"):
        draw(joined([_file({"adc": {"0": _run((1, 20))}})]), tmp_path / "figure.png", ["adc"])
    assert not list(tmp_path.iterdir())
