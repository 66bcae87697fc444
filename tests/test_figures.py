"""Figures of error against time: what is drawn, where, and by which marks it is told apart."""

import json

import numpy as np
import pytest
from matplotlib.figure import Figure

from applications.evaluation.figures import draw_cameras, draw_curves, draw_sizes
from applications.evaluation.report import _find_cameras
from splatting.records.error_curve import COLUMNS
from splatting.records.figures import draw_curve

NAMES = ("seconds", "test_psnr", "test_ssim", "train_psnr", "train_ssim", "subset")


@pytest.fixture
def drawn(monkeypatch) -> list[Figure]:
    """The figures that are saved."""
    figures, plain = [], Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (figures.append(self), plain(self, *a, **k)))
    return figures


def curve(*rows: tuple) -> list[dict]:
    empty = dict.fromkeys(COLUMNS)
    return [empty | {"iteration": i} | dict(zip(NAMES, row, strict=False)) for i, row in enumerate(rows, 1)]


def runs_of(curves: dict) -> list[dict]:
    common = {"apart": False, "finished": True, "views": {"test": 7}}
    return [common | {"config": config, "curve": rows} for config, rows in curves.items()]


def points(axes, label: str) -> list:
    """Points of the lines with a label."""
    return [line.get_xydata().tolist() for line in axes.lines if line.get_label() == label]


def hollow(axes) -> list:
    """Points of the marks that are not filled."""
    return [line.get_xydata().tolist() for line in axes.lines if line.get_markerfacecolor() == "white"]


def test_the_curve_of_a_training(tmp_path, drawn):
    """Each subset of the views has a line of its own, and whole sets beside it are hollow; the best and the end."""
    rows = curve(
        (0.5, 9.0, 0.5, 9.5, 0.5, 4), (1.0, 10.0, 0.75, 11.0, 0.875, 4), (1.0, 15.0, 0.75, None, 0.875),
        (4.0, 12.0, 0.75, 18.0, 0.875, 4), (4.0, 14.0, 0.75, 20.5, 0.875),
    )  # fmt: skip
    draw_curve(tmp_path / "error_vs_time.png", rows, "a model", {"test": 7, "train": 6})
    upper, lower = drawn[0].axes
    assert upper.get_xscale() == lower.get_xscale() == lower.get_yscale() == "log"
    assert points(upper, "4 of 7 test views") == [[[0.5, 9], [1, 10], [4, 12]]]
    assert points(upper, "4 train views") == [[[0.5, 9.5], [1, 11], [4, 18]]]
    assert points(upper, "all 7 test views") == [[[1, 15], [4, 14]]] and points(upper, "6 train views") == [[[4, 20.5]]]
    assert points(upper, "highest mean over all test views: 15.00 dB, iteration 3") == [[[1, 15]]]
    assert hollow(upper) == [[[1, 15], [4, 14]], [[4, 20.5]]]
    legends = [text.get_text() for axes in (upper, lower) for text in axes.get_legend().get_texts()]
    assert "gap, 6.5 dB at the end" in legends and "gap, 0.125 at the end" in legends  # of all views
    for axes in (upper, lower):
        assert not axes.get_legend().get_window_extent().overlaps(axes.get_window_extent())
    assert not lower.get_legend().get_window_extent().overlaps(lower.xaxis.label.get_window_extent())
    draw_curve(tmp_path / "error_vs_time.png", [rows[2], rows[4]], "a model", {"test": 7, "train": 6})
    assert points(drawn[1].axes[0], "all 7 test views") == [[[1, 15], [4, 14]]] and not hollow(drawn[1].axes[0])


def test_lines_are_of_the_views_on_which_all_runs_compare(tmp_path, drawn):
    """All views are apart from them, at the end, too. Other programs, which score all views, are told from them."""
    whole = [curve((9.0, 50.0, 0.99))[0] | {"iteration": 2}]
    curves = [curve((t, p, 0.8, None, None, n), (9.0, p + 1, 0.9, None, None, n)) for t, p, n in
              ((1.0, 20.0, 2), (2.0, 22.0, 2), (3.0, 24.0, 4))]  # fmt: skip
    peer = {"name": "other", "curve": curve((0.5, 40.0))}
    draw_curves(tmp_path, "attic", runs_of({name: curves[i] + whole for i, name in enumerate("ab")}), [peer])
    draw_curves(tmp_path, "attic", runs_of({name: curves[i] + whole for i, name in enumerate("abc")}))
    apart = runs_of({"c": curves[2] + whole})[0] | {"apart": True}
    draw_curves(tmp_path, "attic", [*runs_of({name: curves[i] for i, name in enumerate("ab")}), apart])
    assert drawn[4].legends[0].get_title().get_text().startswith("2 of ")
    same, mixed = drawn[0].axes[0], drawn[2].axes[0]
    assert points(same, "b") == [[[2.0, 22.0], [9.0, 23.0]]] and hollow(same) == [[[9.0, 50.0]]] * 2
    said = [figure.legends[0].get_title().get_text().splitlines()[0] for figure in drawn[:4:2]]
    assert said == ["2 of 7 test views; hollow and other programs: all of them", "all 7 test views"]
    assert [points(mixed, name) for name in "abc"] == [[[[9.0, 50.0]]]] * 3 and not hollow(mixed)


def test_seeds_are_a_mean_and_a_band_where_they_are_alike_and_an_unfinished_training_is_told(tmp_path, drawn):
    first, second, short = (curve(*rows) for rows in ([(1, 20), (4, 30)], [(3, 22), (6, 33)], [(1, 21)]))
    several = runs_of({"a": first}) + runs_of({"a": second})
    draw_curves(tmp_path, "attic", [*several, *(run | {"config": "b"} for run in several[:1])])
    draw_curves(tmp_path, "attic", [*several, *(run | {"finished": False, "curve": short} for run in several[:1])])
    alike, other = drawn[0], drawn[2]
    (band,) = alike.axes[0].collections
    assert points(alike.axes[0], "a") == [[[2, 21], [5, 31.5]]]
    assert {tuple(place) for place in band.get_paths()[0].vertices} >= {(2, 20), (2, 22), (5, 30), (5, 33)}
    assert alike.legends[0].get_title().get_text().endswith("\nmean of the seeds, band: all of them")
    assert points(other.axes[0], "a (not finished)") == [[[1, 21]]]


def test_psnr_against_size_has_a_line_for_sets_that_differ_in_their_last_word(tmp_path, drawn):
    ends = {"adc-2k": (2000, 30.0), "adc-1k": (900, 29.0), "mcmc-1k": (1000, 29.5), "budget": (500, 28.0)}
    common = {"seed": 0, "apart": False, "final_iteration": 7}
    runs = [
        common | {"config": name, "iterations": {"7": {"PSNR": psnr, "gaussians": count}}}
        for name, (count, psnr) in ends.items()
    ]
    runs += [runs[0] | {"seed": 1}, runs[0] | {"apart": True, "config": "x"}, runs[1] | {"final_iteration": None}]
    assert [file.name for file in draw_sizes(tmp_path, "attic", runs)] == ["attic_size.png"]
    (axes,) = drawn[0].axes
    assert points(axes, "adc") == [[[0.9, 29.0], [2.0, 30.0]]] and points(axes, "mcmc") == [[[1.0, 29.5]]]
    assert [text.get_text() for text in drawn[0].legends[0].get_texts()] == ["adc", "mcmc", "budget"]
    assert sum(len(line.get_xdata()) for line in axes.lines) == 5
    equal = [run | {"iterations": {"7": {"PSNR": 30.0, "gaussians": 1000 + i}}} for i, run in enumerate(runs[:3])]
    assert (
        draw_sizes(tmp_path, "attic", equal)
        == draw_sizes(tmp_path, "attic", runs[:1])
        == draw_sizes(tmp_path, "attic", runs[-1:])
        == []
    )


def test_cameras_from_above_are_drawn_once_for_each_split(tmp_path, drawn):
    turn = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # looks along y, its head towards z
    cameras = [{"position": [x, 2.0 * x, 9.0], "rotation": turn} for x in range(5)]
    runs = []
    every, block = "every 8th by name", "--holdout block"
    for model, split, entries in (("a", every, cameras), ("b", block, cameras),
                                  ("c", every, cameras), ("d", "other", [{"img_name": "x"}])):  # fmt: skip
        (tmp_path / model).mkdir()
        (tmp_path / model / "cameras.json").write_text(json.dumps(entries))
        runs.append({"model": model, "split": split, "views": {"train": 3}})
    splits = _find_cameras(tmp_path, [*runs, {"model": "gone", "split": None, "views": {"train": None}}])
    assert {name: [len(one) for one in both] for name, both in splits.items()} == {
        "every 8th by name": [2, 3], "--holdout block": [2, 3]}  # fmt: skip
    test, train = splits["--holdout block"]
    places = np.concatenate([test, train])
    steps = np.diff(places[:, :2], axis=0)
    assert np.allclose(np.linalg.norm(steps, axis=1), 5**0.5) and np.allclose(places[:, 2:], places[0, 2:])
    across = steps[0, 0] * places[0, 3] - steps[0, 1] * places[0, 2]
    assert np.isclose(across, 1) and np.isclose(steps[0] @ places[0, 2:], 2)  # not mirrored: the axis is to the left
    files = draw_cameras(tmp_path, "attic", splits)
    assert [file.name for file in files] == ["attic_cameras_1.png", "attic_cameras_2.png"]
    shown = {one.get_label(): one.N for one in drawn[1].axes[0].collections}
    assert shown == {"2 test views": 2, "3 train views": 3}
