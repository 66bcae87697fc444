"""Figures of error against time and of fronts: what is drawn, where, and by which marks it is told apart."""

import pytest
from matplotlib.figure import Figure
from PIL import Image

from splatting.evaluation.error_curve import COLUMNS
from splatting.evaluation.figures import draw_curve, draw_curves, draw_fronts

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
    return [{"apart": False, "config": config, "curve": rows} for config, rows in curves.items()]


def points(axes, label: str | None = None, style: str | None = None) -> list:
    """Points of the lines with a label or a fill style."""
    lines = [line for line in axes.lines if line.get_label() == label or line.get_fillstyle() == style]
    return [line.get_xydata().tolist() for line in lines]


def test_the_curve_of_a_training(tmp_path, drawn):
    """Of whole sets the lines, the gap and the best; of subsets hollow points on lines of their own."""
    rows = curve(
        (0.5, 30.0, 0.5, 31.0, 0.5, 4), (1.0, 10.0, 0.75, 11.0, 0.875), (1.5, 12.0, 0.5, 13.0, 0.5, 4),
        (2.0, 15.0, 0.75, None, 0.875), (4.0, 14.0, 0.75, 20.0, 0.875),
    )  # fmt: skip
    draw_curve(tmp_path / "error_vs_time.png", rows, "a model")
    with Image.open(tmp_path / "error_vs_time.png") as image:
        assert min(image.size) > 400 and len(image.convert("RGB").getcolors(10**6)) > 10
    upper, lower = drawn[0].axes
    assert upper.get_xscale() == lower.get_xscale() == lower.get_yscale() == "log"
    assert points(upper, "test views") == [[[1, 10], [2, 15], [4, 14]]]
    assert points(upper, "train views") == [[[1, 11], [4, 20]]]
    assert points(upper, "test views, 4 of them") == [[[0.5, 30], [1.5, 12]]]
    assert points(upper, "best test: 15.00 dB, iteration 4") == [[[2, 15]]]
    assert points(upper, style="none") == [[[0.5, 30], [1.5, 12]], [[0.5, 31], [1.5, 13]]]
    assert [y for _, y in points(lower, "train views")[0]] == [0.125] * 3
    legends = [text.get_text() for axes in (upper, lower) for text in axes.get_legend().get_texts()]
    assert "gap, 6 dB at the end" in legends and "gap, 0.125 at the end" in legends


@pytest.mark.parametrize("rows", [(), ((1,),), ((1, 5.0),), ((1, 5.0, 1.0, None, 1.0),)])
@pytest.mark.filterwarnings("error")
def test_little_to_draw(tmp_path, rows):
    draw_curve(tmp_path / "error_vs_time.png", curve(*rows), "")
    assert (tmp_path / "error_vs_time.png").stat().st_size > 1000


def test_the_legend_leaves_the_pareto_front_free(tmp_path, drawn):
    curves = {
        "base": curve((0.3, 15.0, 0.7), (2.8, 29.0, 0.945)),
        "fast start": curve((0.3, 21.0, 0.8), (3.3, 29.5, 0.95)),
    } | {f"set {i}": curve((0.31, 15.0, 0.7), (2.9, 28.5, 0.94)) for i in range(6)}  # fmt: skip
    assert draw_curves(tmp_path / "curves.png", "attic", runs_of(curves))
    fronts = [next(line for line in axes.lines if line.get_label() == "Pareto front") for axes in drawn[0].axes]
    assert fronts[0].get_xydata().tolist() == [[0.3, 21.0], [2.8, 21.0], [2.8, 29.0], [3.3, 29.0], [3.3, 29.5]]
    assert fronts[0].get_markevery() == 2  # corners are not marked
    for axes, front in zip(drawn[0].axes, fronts, strict=True):
        line = front.get_path().transformed(front.get_transform())
        assert not line.intersects_bbox(axes.get_legend().get_window_extent(), filled=False)


def test_points_of_subsets_are_hollow_and_in_no_front(tmp_path, drawn):
    rows = curve((0.3, 35.0, 0.9, 36.0, 0.9, 2), (1.0, 36.0, 0.95, 37.0, 0.9, 2), (2.0, 20.0, 0.8, 21.0, 0.8))
    for runs in (runs_of({None: rows}), runs_of({"a": rows, "b": rows[:2]})):
        assert draw_curves(tmp_path / "curves.png", "attic", runs)
        axes = drawn[-1].axes
        assert axes[0].get_ylabel() == "PSNR of the test views (dB)"
        hollow = points(axes[0], style="none")
        assert [[0.3, 35.0], [1.0, 36.0]] in hollow and [[2.0, 20.0]] in points(axes[0], style="full")
        assert ([[0.3, 36.0], [1.0, 37.0]] in hollow) == (len(runs) == 1)  # the training views
    assert points(axes[0], "Pareto front") == [[[2.0, 20.0]]]
    # The gap between training and test views has a panel of its own, without the difference of two subsets.
    assert axes[2].get_ylabel() == "PSNR of the training views above the test views (dB)"
    assert [line.get_xydata().tolist() for line in axes[2].lines] == [[[2.0, 1.0]], []]


def test_other_programs_and_sets_that_stand_apart_are_drawn_and_in_no_front(tmp_path, drawn):
    rows = curve((1.0, 20.0, 0.6), (9.0, 25.0, 0.8))
    runs = [*runs_of({"base": rows, "sh1": rows}), {"apart": True, "config": "best", "curve": curve((0.2, 50.0, 0.9))}]
    peer = {"name": "other", "curve": curve((0.5, 40.0))}  # would be the whole front
    assert draw_curves(tmp_path / "curves.png", "attic", runs, [peer])
    left, right, *_ = drawn[0].axes
    assert points(left, "other (another program)") == [[[0.5, 40.0]]]
    assert points(left, "best (other ground truth)") == [[[0.2, 50.0]]]
    assert points(left, "Pareto front") == [[[1.0, 20.0], [9.0, 20.0], [9.0, 25.0]]]
    said = [axes.get_xlabel().endswith("(other programs: as they count)") for axes in (left, right)]
    assert said == [True, False] and not points(right, "other (another program)")  # it has no SSIM


def test_fronts_have_a_point_and_a_bar_for_each_set(tmp_path, drawn):
    def spread(mean: float) -> dict:
        return {"mean": mean, "std": 0.1, "values": []}

    ends = {"adc": (31.2, 40, 300, 3), "fast": (32.2, 20, 500, 5), "small": (30.4, 50, 70, 0.7)}
    names = ("PSNR", "seconds", "gaussians", "ply_mb")
    found = {"sets": {one: dict(zip(names, map(spread, values), strict=True)) for one, values in ends.items()}}
    assert draw_fronts(tmp_path / "fronts.png", "attic", found, ["apart", *ends])
    seconds, gaussians, megabytes = drawn[0].axes
    assert megabytes.get_xlabel() == "megabytes of the PLY"
    assert [bar.lines[0].get_xydata().tolist()[0] for bar in seconds.containers] == [[40, 31.2], [20, 32.2], [50, 30.4]]
    assert [bar.lines[0].get_color() for bar in seconds.containers] == ["C1", "C2", "C3"]  # as in the other figure
    assert all(len(bar.lines[2]) == 2 for bar in seconds.containers)  # of both numbers
    for axes, costs in ((seconds, [20]), (gaussians, [70, 300, 500])):
        assert [x for x, _ in points(axes, "Pareto front")[0][::2]] == costs
