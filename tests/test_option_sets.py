"""Tables and figures about option sets: seconds to reach a PSNR, Pareto fronts, sets of other ground truth."""

import json
from pathlib import Path

import pytest
from matplotlib.figure import Figure

import train
from splatting.evaluation import configs
from splatting.evaluation.configs import read_configs, shipped
from splatting.evaluation.document import document, front_table, reached_table, result_blocks
from splatting.evaluation.error_curve import COLUMNS
from splatting.evaluation.figures import draw_fronts
from splatting.evaluation.option_sets import (
    comparable_sets,
    default_set,
    fronts,
    reached,
    round_levels,
    stand_apart,
)
from splatting.evaluation.report import make_report
from splatting.evaluation.summary import QUANTITIES
from utils.system_utils import UserError

ROOT = Path(__file__).parents[1]
GUIDE = ROOT / "docs" / "guide" / "many_scenes.md"


def _run(config: str, seed: int, curve: list[tuple[float, float, int]], **more) -> dict:
    """A finished run of "attic" with a curve of (seconds, test PSNR, Gaussians), saved at 100 bytes a Gaussian."""
    rows = [
        dict.fromkeys(COLUMNS) | {"iteration": 10 * i, "seconds": s, "test_psnr": p, "gaussians": n}
        for i, (s, p, n) in enumerate(curve, 1)
    ]
    end = 10 * len(curve)
    seconds, psnr, gaussians = curve[-1]
    values = dict.fromkeys(QUANTITIES) | {
        "PSNR": psnr, "seconds": seconds, "gaussians": gaussians, "gaussians_saved": gaussians,
        "ply_mb": gaussians / 1e4, "views": 2,
    }  # fmt: skip
    run = {
        "added_options": [], "apart": False, "config": config, "conventions": {}, "cpu_seconds": None, "curve": rows,
        "failure": None, "final_iteration": end, "finished": True, "ground_truth_sha256": "a" * 64, "group": "scenes",
        "iterations": {str(end): values}, "lines": [], "machine": {}, "model": f"attic/{config}/{seed}",
        "open_ended": False, "options": [], "page": None, "peak": None, "scene": "attic", "seed": seed, "source": None,
        "split": None, "test_sizes": [[96, 64]], "views": {"test": 2, "train": 7}, "wall_seconds": None,
        "worst_views": [],
    }  # fmt: skip
    return run | more


def _runs() -> list[dict]:
    """Three sets of two seeds: `fast` gets there in half the seconds, `small` in none, but it has few Gaussians."""
    return [
        _run("adc", 0, [(10, 20.0, 100), (20, 30.0, 200), (40, 31.0, 300)]),
        _run("adc", 1, [(10, 20.0, 100), (20, 30.0, 200), (40, 31.4, 300)]),
        _run("fast", 0, [(5, 20.0, 100), (10, 30.0, 400), (20, 32.2, 500)]),
        _run("fast", 1, [(5, 20.0, 100), (10, 30.0, 400), (20, 32.2, 500)]),
        _run("small", 0, [(10, 20.0, 50), (30, 29.0, 60), (50, 30.0, 70)]),
        _run("small", 1, [(10, 20.0, 50), (30, 29.0, 60), (50, 30.8, 70)]),
    ]


@pytest.mark.parametrize(
    ("finals", "levels"),
    [
        ([30.43, 30.11], [30.4, 30.3, 30.2, 30.0]),
        ([30.3, 29.8], [30.0, 29.5]),
        ([30.43, 27.1], [30.0, 29.5, 29.0, 28.0, 26.0]),
        ([30.43, 20.0], [30.0, 29.0, 28.0, 26.0, 22.0]),
        ([30.1, 30.1], [30.1]),
    ],
)
def test_levels_are_round_and_lie_around_the_final_ones(finals, levels):
    assert round_levels(finals) == levels


def test_seconds_gaussians_and_megabytes_to_reach_a_level():
    found = reached(comparable_sets(_runs(), "attic"))
    assert found["default"] == "adc"
    levels = [(level["psnr"], level["of_default"]) for level in found["levels"]]
    assert levels == [(32.0, False), (31.5, False), (pytest.approx(31.2, abs=2e-6), True), (31.0, False), (30.0, False)]
    own, fast, small = (found["sets"][name]["cells"] for name in ("adc", "fast", "small"))
    thirty = fast[4]
    assert thirty["seconds"]["values"] == [pytest.approx(10.0)] * 2 and thirty["seconds"]["std"] == 0
    assert thirty["gaussians"]["mean"] == 400 and thirty["mb"]["mean"] == pytest.approx(0.04)
    assert thirty["ratio"] == pytest.approx(0.5) and own[4]["ratio"] == 1.0
    assert small[4]["reached"] == 2 and small[4]["ratio"] > 2
    assert small[3]["reached"] == 0 and small[3]["seconds"]["mean"] is None and small[3]["ratio"] is None
    # In logarithmic time: 32.0 lies 10/11 of the way from 30.0 to 32.2.
    assert fast[0]["seconds"]["mean"] == pytest.approx(10 * 2 ** (2.0 / 2.2)) and fast[0]["gaussians"]["mean"] == 500
    # Seed 0 of adc ends at 31.0, below the mean 31.2, so its 40 s are a lower bound; seed 1 gets there after 36.6 s.
    assert own[2]["at_least"] and own[2]["reached"] == 1 and not fast[2]["at_least"]
    assert own[2]["seconds"]["values"] == [40.0, pytest.approx(20 * 2 ** (1.2 / 1.4), rel=1e-5)]
    assert fast[2]["ratio"] == pytest.approx(fast[2]["seconds"]["mean"] / own[2]["seconds"]["mean"])


def test_the_table_says_what_is_not_reached():
    table = reached_table(reached(comparable_sets(_runs(), "attic")))
    assert table["header"][:4] == ["options", "final PSNR (dB)", "32.0 dB", "31.5 dB"]
    assert table["header"][4] == "31.20 dB (final PSNR of adc)"
    adc, fast, small = table["rows"]
    assert adc[:3] == ["adc", "31.20 ± 0.28", "not reached"] and adc[4] == "\u2265 38.1 ± 2.7 s (300; 0.0 MB)"
    assert fast[6] == "10.0 ± 0.0 s (400; 0.0 MB), 0.50 of adc's" and small[5] == "not reached"
    assert adc[5] == "36.4 ± 5.1 s (300; 0.0 MB)"  # the end of one seed, and between points of the other
    runs = _runs()
    runs[-1]["curve"][-1]["test_psnr"] = 31.1
    small = reached_table(reached(comparable_sets(runs, "attic")))["rows"][2]
    assert small[-2].startswith("1 of 2 seeds: ") and "adc's" not in small[-2]


def test_equal_seeds_reach_their_own_mean():
    """The mean of three equal numbers may be a bit above them."""
    curve = [(1, 20.0, 1), (2, 29.839999999999996, 2)]
    runs = [_run(name, seed, curve) for name in ("base", "other") for seed in range(3)]
    cells = reached(comparable_sets(runs, "attic"))["sets"]["other"]["cells"]
    assert [cell["reached"] for cell in cells] == [3] * len(cells)


def test_what_cannot_be_compared_is_left_out():
    runs = _runs()
    assert comparable_sets(runs[:2], "attic") == {} == comparable_sets(runs, "cellar")  # one set alone
    runs[2]["finished"] = False
    runs[4]["apart"] = runs[5]["apart"] = True
    assert {name: len(found) for name, found in comparable_sets(runs, "attic").items()} == {"adc": 2, "fast": 1}
    for row in runs[3]["curve"]:
        row["subset"] = 3
    assert reached(comparable_sets(runs, "attic")) is None
    assert fronts(comparable_sets(runs, "attic")) is not None  # these numbers are of metrics.py


def test_fronts_say_who_beats_whom():
    found = fronts(comparable_sets(_runs(), "attic"))
    # fast: 20 s, 32.2 dB, 500; adc: 40 s, 31.2 dB, 300; small: 50 s, 30.4 dB, 70.
    assert found["beaten"]["seconds"] == {
        "adc": {"by": "fast", "clearly": True}, "fast": None, "small": {"by": "fast", "clearly": True},
    }  # fmt: skip
    assert found["beaten"]["gaussians"] == dict.fromkeys(("adc", "fast", "small"))
    assert found["beaten"]["ply_mb"] == dict.fromkeys(("adc", "fast", "small"))
    adc, fast, _ = front_table(found)["rows"]
    assert adc[:4] == ["adc", "31.20 ± 0.28", "40.0 ± 0.0", "no: fast"] and fast[3] == "yes"


def test_a_set_within_the_spread_is_called_so():
    runs = _runs()[:2] + [_run("near", seed, [(seconds, 31.25, 300)]) for seed, seconds in ((0, 36), (1, 43.5))]
    found = fronts(comparable_sets(runs, "attic"))
    assert found["beaten"]["seconds"] == {"adc": {"by": "near", "clearly": False}, "near": None}
    assert front_table(found)["rows"][0][3] == "no: near, within the spread"
    one = fronts(comparable_sets([runs[0], _run("near", 0, [(39, 31.25, 300)])], "attic"))
    assert one["beaten"]["seconds"]["adc"] == {"by": "near", "clearly": None}
    assert front_table(one)["rows"][0][3] == "no: near"
    twins = fronts(comparable_sets([runs[0], runs[0] | {"config": "twin"}], "attic"))
    assert twins["beaten"]["seconds"] == {"adc": None, "twin": None}


def test_the_figure_has_a_point_and_a_bar_for_each_set(tmp_path, monkeypatch):
    drawn, plain = [], Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (drawn.append(self), plain(self, *a, **k)))
    found = fronts(comparable_sets(_runs(), "attic"))
    assert draw_fronts(tmp_path / "fronts.png", "attic", found, ["apart", "adc", "fast", "small"])
    seconds, gaussians, megabytes = drawn[0].axes
    assert megabytes.get_xlabel() == "megabytes of the PLY"
    marked = [bar.lines[0].get_xydata().tolist()[0] for bar in seconds.containers]
    assert marked == [[40, pytest.approx(31.2)], [20, pytest.approx(32.2)], [50, pytest.approx(30.4)]]
    assert [bar.lines[0].get_color() for bar in seconds.containers] == ["C1", "C2", "C3"]  # as in the other figure
    assert all(len(bar.lines[2]) == 2 for bar in seconds.containers)  # of both numbers
    for axes, costs in ((seconds, [20]), (gaussians, [70, 300, 500])):
        (front,) = (line for line in axes.lines if line.get_label() == "Pareto front")
        assert [x for x, _ in front.get_xydata()[::2]] == costs


def _other(run: dict, **change) -> dict:
    return run | {"ground_truth_sha256": "b" * 64} | change


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"test_sizes": [[48, 32]], "options": ["-r", "2", "--sh_degree", "1"]},
         "its test views have 48x32 pixels, the others' 96x64; -r 2 instead of the defaults"),
        ({"test_sizes": [[48, 64]], "options": ["--sh_degree", "1", "--train_test_exp"]},
         "its test views have 48x64 pixels, the others' 96x64; --train_test_exp instead of the defaults"),
        ({"options": ["--masks", "foreground"]},
         "the pixels of its test views differ, or which of them count; --masks foreground instead of the defaults"),
        ({"views": {"test": 3, "train": 6}}, "it has 3 test views, the others 2"),
        ({"ground_truth_sha256": None}, "its ground truth is not known"),
    ],
)  # fmt: skip
def test_a_set_that_stands_apart_is_told_why(change, why):
    runs = _runs()
    runs[4:] = [_other(run, **change) for run in runs[4:]]
    if change.get("ground_truth_sha256", "") is None:
        runs[2] = _other(runs[2])
        runs = [runs[0], runs[1], runs[2], *runs[4:]]
    marked = stand_apart(runs)
    assert {run["config"] for run in marked if run["apart"]} >= {"small"}
    assert marked[-1]["why_apart"] == why and marked[0]["why_apart"] is None
    report = make_report(["full_eval.py"], runs)
    assert "small" not in str(report["reached"]) and "small" not in str(report["fronts"])
    _, title, table = result_blocks(report["summary"])
    assert f"attic, small: {why}." in title and "small" in [row[1] for row in table["rows"]]


def test_seeds_of_different_ground_truth_are_told_so():
    runs = _runs()
    runs[5] = _other(runs[5])
    assert {run["why_apart"] for run in stand_apart(runs)[4:]} == {"its seeds were scored on different ground truth"}


def test_the_report_has_both_sections():
    sections = dict(document(make_report(["x"], _runs()), {}, {}))
    blocks = sections["Seconds to reach a test PSNR"]
    assert blocks[0] == "attic, compared with adc:" and "linear in the logarithm of the seconds" in blocks[2]
    assert "over the seeds" in blocks[3] and sections["Pareto fronts of option sets"][0] == "attic"
    plain = dict(document(make_report(["x"], _runs()[:2]), {}, {}))
    assert not plain.keys() & {"Seconds to reach a test PSNR", "Pareto fronts of option sets"}


def test_seeds_that_end_by_themselves_share_a_row():
    def ended(seed: int, points: int) -> dict:
        curve = [(10 * i, 20.0 + i, 100) for i in range(1, points + 1)]
        run = _run("adc-20s", seed, curve, open_ended=True)
        run["iterations"] |= {"5": run["iterations"][str(10 * points)] | {"PSNR": 15.0}}  # saved on the way
        return run

    runs = [ended(0, 2), ended(1, 4), ended(2, 9) | {"finished": False}]
    report = make_report(["x"], [*_runs(), *runs])
    (row,) = (row for row in report["summary"] if row["config"] == "adc-20s")
    assert row["iterations"] == [20, 40] and row["iteration"] == 30 and row["seeds"] == [0, 1]
    assert row["PSNR"]["values"] == [22.0, 24.0]
    (table,) = result_blocks(report["summary"])
    cells = dict(zip(table["header"], table["rows"][-1], strict=True))
    assert cells["iteration"] == "20 to 40"
    said = dict(document(report, {}, {}))["Results"]
    assert any("end by themselves" in block for block in said if isinstance(block, str))


def test_shipped_sets_are_options_of_training(tmp_path, monkeypatch):
    assert "strategies" in shipped()
    for name in shipped():
        sets = read_configs(Path(name), train.parse)
        assert read_configs(configs.SHIPPED / f"{name}.json", train.parse) == sets and len(sets) > 1
        rows = [line.split("|")[1] for line in GUIDE.read_text().splitlines() if line.startswith("| `")]
        described = {name for row in rows for name in row.split("`")[1::2]}
        assert set(sets) <= described, f"{GUIDE.name} does not tell what these are for"
    assert default_set(read_configs(Path("strategies"), None)) == "adc" == default_set({"defaults": [], "adc": []})
    assert default_set({"fast": [], "defaults": []}) == "defaults" and default_set({"x": [], "y": []}) == "x"
    assert read_configs(Path("strategies"), None)["adc"] == ()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "strategies").write_text(json.dumps({"mine": []}))  # a file comes first
    assert list(read_configs(Path("strategies"), None)) == ["mine"]
    with pytest.raises(UserError, match="cannot read strategy .*or strategies"):
        read_configs(Path("strategy"), None)
