"""Runs beside each other: spread, levels and fronts of option sets, published tables, and the tables of them."""

import json
import re
import statistics
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from report_runs import curve, run_of, set_runs

import train
from splatting.evaluation.comparison import (
    comparable_sets,
    compare,
    default_set,
    fronts,
    pareto_front,
    published_tables,
    reached,
    round_levels,
    seconds_to_reach,
    spread,
    stand_apart,
    summarise,
)
from splatting.evaluation.configs import read_configs, shipped
from splatting.evaluation.plan import DATASETS
from splatting.evaluation.report import make_report, render
from splatting.evaluation.tables import front_table, reached_legend, reached_table, result_tables
from splatting.files.listing import markdown_table
from utils.system_utils import UserError

ROOT = Path(__file__).parents[1]


def test_spread():
    std = pytest.approx(statistics.stdev([1, 2, 4]))
    assert spread([1.0, 2.0, 4.0]) == {"mean": pytest.approx(7 / 3), "std": std, "values": [1.0, 2.0, 4.0]}
    assert spread([5.0])["std"] is None and spread([5.0])["mean"] == 5.0
    assert spread([5.0, None])["mean"] is None and spread([])["mean"] is None


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), max_size=30))
def test_pareto_front_is_what_nothing_beats(points):
    front = pareto_front(points)
    beaten = {p for p in points for q in points if q != p and q[0] <= p[0] and q[1] <= p[1]}
    assert {points[i] for i in front} == set(points) - beaten
    assert len({points[i] for i in front}) == len(front) and front == sorted(front, key=lambda i: points[i])


def test_seconds_to_reach_between_points():
    rows = curve((1, 10, 100), (100, 20, 300), (200, 19, 250), (300, 30, 400))
    assert [seconds_to_reach(rows, level) for level in (9, 31)] == [None, None]  # before the first point; never
    assert seconds_to_reach(rows, 15) is None  # too far from the point before to interpolate
    assert seconds_to_reach(rows, 24.5) == pytest.approx((200 * 300) ** 0.5)  # halfway in the logarithm


def test_a_failed_seed_is_left_out_and_named():
    runs = [run_of(None, seed, (1, 1.0 + seed, 9), failure=[None, {"stage": "train"}][seed == 1]) for seed in range(3)]
    (row,) = summarise(runs)
    assert row["PSNR"] == {"mean": 2.0, "std": pytest.approx(2**0.5), "values": [1.0, 3.0]}
    assert row["seeds"] == [0, 2] and row["failed_seeds"] == [1]


@pytest.mark.parametrize(
    ("finals", "levels"),
    [
        ([30.43, 30.11], [30.0, 29.5, 29.0, 28.0]),
        ([30.43, 20.0], [30.0, 29.5, 29.0, 28.0, 26.0, 22.0, 14.0]),
        ([30.5, 26.5], [30.5, 30.0, 29.5, 28.5, 26.5, 22.5]),
    ],
)
def test_levels_are_round_and_lie_around_the_final_ones(finals, levels):
    assert round_levels(finals) == levels


def test_seconds_and_gaussians_to_reach_a_level():
    found = reached(comparable_sets(set_runs(), "attic"))
    levels = [(level["psnr"], level["of_default"]) for level in found["levels"]]
    assert levels == [(32.0, False), (31.5, False), (pytest.approx(31.2, abs=2e-6), True), (31.0, False), (30.0, False)]
    own, fast, small = (found["sets"][name] for name in ("adc", "fast", "small"))
    assert fast[4]["seconds"]["values"] == [pytest.approx(10.0)] * 2 and fast[4]["seconds"]["std"] == 0
    assert fast[4]["gaussians"]["mean"] == 400
    assert fast[4]["ratio"] == pytest.approx(0.5) and own[4]["ratio"] == 1.0
    assert small[4]["reached"] == 2 and small[4]["ratio"] > 2
    assert small[3]["reached"] == 0 and small[3]["seconds"]["mean"] is None and small[3]["ratio"] is None
    # In logarithmic time: 32.0 lies 10/11 of the way from 30.0 to 32.2.
    assert fast[0]["seconds"]["mean"] == pytest.approx(10 * 2 ** (2.0 / 2.2)) and fast[0]["gaussians"]["mean"] == 500
    # Seed 0 of adc ends at 31.0, below the mean 31.2, so that the end of adc takes all its 40 s.
    assert own[2]["at_end"] and own[2]["reached"] == 1 and not fast[2]["at_end"]
    assert own[2]["seconds"]["values"] == [40.0, 40.0]
    assert fast[2]["ratio"] == pytest.approx(fast[2]["seconds"]["mean"] / own[2]["seconds"]["mean"])

    table = reached_table(found)
    assert table.header == ["options", "32.0 dB", "31.5 dB", "adc's end", "31.0 dB", "30.0 dB"]
    adc, fast, small = table.rows
    assert adc[:2] == ["adc", "not reached"] and adc[3] == "40.0 ± 0.0 s"
    assert reached_legend(found) == "PSNR of the test views: all. In brackets: the part of adc's seconds."
    assert fast[5] == "10.0 ± 0.0 s (50 %)" and small[4] == "not reached"
    assert adc[4] == "36.4 ± 5.1 s"  # the end of one seed, and between points of the other
    runs = set_runs()
    runs[-1]["curve"][-1]["test_psnr"] = 31.1
    found = reached(comparable_sets(runs, "attic"))
    table = reached_table(found)
    assert reached_legend(found).endswith(" 1 of 2 seeds: the mean of those that got there.")
    assert table.rows[0][3] == "40.0 ± 0.0 s"
    assert table.rows[2][4] == "48.8 s, 1 of 2 seeds"


def test_levels_are_reached_on_the_views_that_all_runs_score():
    runs, parts = set_runs(), set_runs()
    for run in parts:  # a subset that is 5 dB easier, scored at all points, and the whole at the end alone
        easy = [row | {"test_psnr": row["test_psnr"] + 5, "subset": 3} for row in run["curve"]]
        run |= {"curve": [*easy, run["curve"][-1]], "views": {"test": 8, "train": 7}}
    whole, part = (reached(comparable_sets(some, "attic")) for some in (runs, parts))
    assert (whole["subset"], part["subset"], part["views"]) == (None, 3, 8)
    assert reached_legend(part).startswith("PSNR of the test views: 3 of 8, the same at all points. All 8 decide")
    assert [level["psnr"] - 5 for level in part["levels"]] == pytest.approx([x["psnr"] for x in whole["levels"]])
    for name, cells in whole["sets"].items():
        of_part = [cell["seconds"]["values"] for cell in part["sets"][name]]
        assert of_part == [pytest.approx(cell["seconds"]["values"]) for cell in cells]
    for row in parts[3]["curve"][:-1]:  # one seed scores others, and compares at its end alone
        row["subset"] = 2
    assert reached(comparable_sets(parts, "attic")) is None


def test_all_views_decide_whether_a_run_ends_as_well_as_the_default_set():
    """One view of the curve's points ranks `better` below base and `worse` above it; all views say the reverse."""
    runs = []
    for name, on_one, on_all in (("base", 29.3, 28.0), ("better", 29.2, 28.1), ("worse", 29.4, 27.9)):
        run = run_of(name, 0, (5, 26.0, 100), (9, on_one, 200))
        one, end = [row | {"subset": 1} for row in run["curve"]], run["curve"][-1]
        runs.append(run | {"curve": [*one, end | {"test_psnr": on_all}], "views": {"test": 6, "train": 7}})
    found = reached(comparable_sets(runs, "attic"))
    place = next(i for i, level in enumerate(found["levels"]) if level["of_default"])
    base, better, worse = (found["sets"][name][place] for name in ("base", "better", "worse"))
    assert base["at_end"] and (better["reached"], worse["reached"]) == (1, 0)
    assert better["gaussians"]["values"] == [200] and worse["gaussians"]["values"] == [None]
    assert [row[1 + place] for row in reached_table(found).rows] == ["9.00 s", "at most 9.00 s (100 %)", "not reached"]
    legend = "1 of 6, the same at all points. All 6 decide whether a run ends as well as base."
    assert legend in reached_legend(found) and "At most: how much earlier is not known." in reached_legend(found)
    for run in runs:
        run["curve"].pop()  # nobody knows better
    found = reached(comparable_sets(runs, "attic"))
    assert [found["sets"][name][place]["reached"] for name in ("better", "worse")] == [0, 1]


def test_no_level_repeats_the_seconds_of_the_end():
    """Of curves that know only their end, or little before it, nothing is told but the end of the default set."""
    runs = [run_of(name, 0, (40, 31.0 + i, 300)) for i, name in enumerate(("adc", "other"))]
    assert reached(comparable_sets(runs, "attic")) is None
    runs = [run_of(name, 0, (1, 15.0, 300), (40, 31.0 + i, 300)) for i, name in enumerate(("adc", "other"))]
    found = reached(comparable_sets(runs, "attic"))
    assert [cell["seconds"]["mean"] for cell in found["sets"]["adc"]].count(40.0) == 1
    assert {cell["seconds"]["mean"] for cells in found["sets"].values() for cell in cells} == {None, 40.0}
    assert reached_table(found).rows[1] == ["other", *["not known"] * len(found["levels"])]


def test_a_level_that_the_first_point_has_took_at_most_its_seconds():
    points = (0.23, 33.0, 100), (0.4, 33.2, 200), (0.8, 33.4, 300)
    runs = [run_of("adc", 0, (0.2, 20.0, 1), (0.4, 33.1, 1), (0.8, 33.4, 1)), run_of("quick", 0, *points)]
    found = reached(comparable_sets(runs, "attic"))
    cells = dict(zip(reached_table(found).header, reached_table(found).rows[1], strict=True))
    assert cells["33.0 dB"].startswith("at most 0.23 s (") and cells["32.5 dB"].startswith("at most 0.23 s (")
    assert "At most: how much earlier is not known." in reached_legend(found)


def test_equal_seeds_reach_their_own_mean():
    """The mean of three equal numbers may be a bit above them."""
    points = (1, 20.0, 1), (2, 29.839999999999996, 2)
    runs = [run_of(name, seed, *points) for name in ("base", "other") for seed in range(3)]
    cells = reached(comparable_sets(runs, "attic"))["sets"]["other"]
    assert [cell["reached"] for cell in cells] == [3] * len(cells)


def test_what_cannot_be_compared_is_left_out():
    runs = set_runs()
    assert comparable_sets(runs[:2], "attic") == {} == comparable_sets(runs, "cellar")  # one set alone
    runs[2]["finished"] = False
    runs[4]["apart"] = runs[5]["apart"] = True
    assert {name: len(found) for name, found in comparable_sets(runs, "attic").items()} == {"adc": 2, "fast": 1}
    for row in runs[3]["curve"]:
        row["subset"] = 3
    assert reached(comparable_sets(runs, "attic")) is None
    assert fronts(comparable_sets(runs, "attic")) is not None  # these numbers are of metrics.py


def test_fronts_say_who_beats_whom_and_whether_clearly():
    found = fronts(comparable_sets(set_runs(), "attic"))
    # fast: 20 s, 32.2 dB, 500; adc: 40 s, 31.2 dB, 300; small: 50 s, 30.4 dB, 70.
    by_fast, nobody = {"by": "fast", "clearly": True}, dict.fromkeys(("adc", "fast", "small"))
    assert found["beaten"] == {
        "seconds": nobody | {"adc": by_fast, "small": by_fast}, "gaussians": nobody, "ply_mb": nobody,
    }  # fmt: skip
    table = front_table(found)
    # Their numbers are in the results.
    assert table.header == ["options", "training (s)", "Gaussians trained", "PLY (MB)"]
    assert table.rows[0] == ["adc", "beaten by fast", "on the Pareto front", "on the Pareto front"]
    assert table.rows[1][1:] == ["on the Pareto front"] * 3

    def beaten(*runs: dict) -> tuple:
        found = fronts(comparable_sets(runs, "attic"))
        return found["beaten"]["seconds"]["adc"], front_table(found).rows[0][1]

    adc = set_runs()[:2]
    for psnr in (31.25, 35):  # its seconds may be more
        near = [run_of("near", seed, (seconds, psnr, 300)) for seed, seconds in enumerate((36, 43.5))]
        assert beaten(*adc, *near) == ({"by": "near", "clearly": False}, "perhaps beaten by near")
    assert beaten(adc[0], run_of("near", 0, (39, 31.25, 300))) == ({"by": "near", "clearly": None}, "beaten by near")
    assert beaten(adc[0], adc[0] | {"config": "twin"}) == (None, "on the Pareto front")
    shares = [run | {"wall_seconds": 100, "cpu_seconds": 60 if run["config"] == "adc" else 90} for run in set_runs()]
    assert beaten(*shares) == ({"by": "fast", "clearly": False}, "perhaps beaten by fast")  # it had more of the CPU
    assert "attic: the trainings got 60 to 90 % of a processor. Where" in make_report(["x"], shares)["warnings"][0]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"test_sizes": [[48, 32]], "options": ["-r", "2", "--sh_degree", "1"]},
         "its test views have 48x32 pixels, the others' 96x64; -r 2 instead of the defaults"),
        ({"options": ["--masks", "foreground"]},
         "the pixels of its test views differ, or which of them count; --masks foreground instead of the defaults"),
        ({"views": {"test": 3, "train": 6}}, "it has 3 test views, the others 2"),
        ({"ground_truth_sha256": None}, "its ground truth is not known"),
    ],
)  # fmt: skip
def test_a_set_that_stands_apart_is_told_why(change, why):
    other = {"ground_truth_sha256": "b" * 64}
    runs = set_runs()
    runs[4:] = [run | other | change for run in runs[4:]]
    if None in change.values():
        runs[2:4] = [runs[2] | other]
    marked = stand_apart(runs)
    assert {run["config"] for run in marked if run["apart"]} >= {"small"}
    assert marked[-1]["why_apart"] == why and marked[0]["why_apart"] is None
    report = make_report(["full_eval.py"], runs)
    assert "small" not in str(report["reached"]) and "small" not in str(report["fronts"])
    _, table = result_tables(report["summary"])
    assert f"attic, small: {why}." in table.title and "small" in [row[1] for row in table.rows]


def test_seeds_of_different_ground_truth_are_told_so():
    runs, why = set_runs(), "its seeds were scored on different ground truth"
    runs[5]["ground_truth_sha256"] = "b" * 64
    assert {run["why_apart"] for run in stand_apart(runs)[4:]} == {why}
    other = runs[2] | {"ground_truth_sha256": "b" * 64}  # both ground truths have two runs, so that all stand apart
    reasons = [run["why_apart"] for run in stand_apart([runs[4], runs[4] | {"seed": 2}, runs[5], other])]
    assert reasons == [why] * 3 + ["the pixels of its test views differ, or which of them count"]


def test_one_option_set_has_no_comparisons(tmp_path):
    shown = {"attic": {"curves": [], "poses": [], "masked": [], "fronts": [], "views": []}}
    page = render("md", make_report(["x"], set_runs()[:2]), shown, tmp_path)
    assert "### Seconds of training to reach a test PSNR" not in page and "### Pareto front" not in page
    assert "robust_mask" not in page
    Image.new("RGB", (2, 2)).save(tmp_path / "masked.png")
    shown["attic"]["masked"] = [tmp_path / "masked.png"]
    page = render("html", make_report(["x"], set_runs()), shown, tmp_path)
    assert re.search(r"<summary>What --robust_mask leaves out of photos</summary>\s*<figure>", page)
    # Where the table is too wide, a cell is broken here alone.
    assert '<table class="wrap">' in page and "10.0\u00a0±\u00a00.0\u00a0s (50\u00a0%)" in page


def test_seeds_that_end_by_themselves_share_a_row():
    runs = []
    for seed, points in enumerate((2, 4, 9)):
        curve = [(10 * i, 20.0 + i, 100) for i in range(1, points + 1)]
        runs.append(run_of("adc-20s", seed, *curve, open_ended=True, finished=seed < 2))
        runs[-1]["iterations"]["5"] = runs[-1]["iterations"][str(10 * points)] | {"PSNR": 15.0}  # saved on the way
    rows = make_report(["x"], [*set_runs(), *runs])["summary"]
    (row,) = (row for row in rows if row["config"] == "adc-20s")
    assert row["iterations"] == [20, 40] and row["iteration"] == 30 and row["seeds"] == [0, 1]
    assert row["PSNR"]["values"] == [22.0, 24.0]
    (table,) = result_tables(rows)
    assert dict(zip(table.header, table.rows[-1], strict=True))["iteration"] == "20 to 40"


def test_published_scenes_add_up_to_the_published_means():
    """Two tables of the paper were transcribed by hand: each mean over scenes must be the printed mean."""
    table = published_tables()[0]
    assert set(table["scenes"]) == {name for scenes in DATASETS.values() for name in scenes}
    for group, by_iteration in table["means"].items():
        for iteration, means in by_iteration.items():
            for metric, half in (("PSNR", 0.005), ("SSIM", 0.0005), ("LPIPS", 0.0005)):
                mean = statistics.fmean(table["scenes"][name][iteration][metric] for name in DATASETS[group])
                # The mean is rounded, and so are the numbers that it is computed from here.
                assert abs(mean - means[metric]) <= 1.5 * half + 1e-12, (group, iteration, metric)


@pytest.mark.parametrize(
    "change", [{}, {"test_sizes": [[400, 400]]}, {"views": {"test": 25, "train": 100}}, {"options": ["--eval"]}]
)
def test_synthetic_scenes_compare_at_full_size_over_white_only(change):
    of_table = {"options": ["--eval", "-w"], "test_sizes": [[800, 800]], "views": {"test": 200, "train": 100}}
    run = run_of(None, None, (1, 35.0, 9), scene="lego", **of_table | change)
    run["iterations"] = {"30000": run["iterations"]["10"]}
    found = compare([run], summarise([run]), [])
    assert bool(found) == (not change)
    if found:
        assert found[0]["numbers"] == {"PSNR": {"ours": 35.0, "published": 35.78, "difference": pytest.approx(-0.78)}}


def test_markdown_keeps_columns_apart():
    table = ["a", "b"], [["x|y", "1"], ["z", "22"]]
    right = ["| a    |   b |", "| ---- | --: |", "| x\\|y |   1 |", "| z    |  22 |"]
    left = ["| a    | b   |", "| ---- | --- |", "| x\\|y | 1   |", "| z    | 22  |"]
    assert [markdown_table(*table).splitlines(), markdown_table(*table, right=False).splitlines()] == [right, left]


def test_shipped_sets_are_options_of_training(tmp_path, monkeypatch):
    assert "strategies" in shipped()
    guide = (ROOT / "docs" / "guide" / "many_scenes.md").read_text().splitlines()
    described = {name for line in guide if line.startswith("| `") for name in line.split("|")[1].split("`")[1::2]}
    for name in shipped():
        sets = read_configs(Path(name), train.parse)
        assert len(sets) > 1 and set(sets) <= described, "many_scenes.md does not tell what these are for"
    assert default_set(read_configs(Path("strategies"), None)) == "adc" == default_set({"defaults": [], "adc": []})
    assert default_set({"fast": [], "defaults": []}) == "defaults" and default_set({"x": [], "y": []}) == "x"
    assert read_configs(Path("strategies"), None)["adc"] == ()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "strategies").write_text(json.dumps({"mine": []}))  # a file comes first
    assert list(read_configs(Path("strategies"), None)) == ["mine"]
    with pytest.raises(UserError, match="cannot read strategy .*or strategies"):
        read_configs(Path("strategy"), None)
