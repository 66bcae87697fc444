"""Runs beside each other: spread, option sets, published tables, and the tables of them."""

import json
import statistics
from pathlib import Path

import pytest
from report_runs import run_of, set_runs

import train
from applications.evaluation.comparison import (
    average_scenes,
    choose_default_set,
    compare,
    mark_apart,
    read_published,
    summarise,
    summarise_spread,
)
from applications.evaluation.configs import list_shipped, read_configs
from applications.evaluation.plan import DATASETS
from applications.evaluation.report import make_report
from applications.evaluation.tables import make_result_tables
from utils.system_utils import UserError

ROOT = Path(__file__).parents[3]


def test_spread():
    std = pytest.approx(statistics.stdev([1, 2, 4]))
    assert summarise_spread([1.0, 2.0, 4.0]) == {"mean": pytest.approx(7 / 3), "std": std, "values": [1.0, 2.0, 4.0]}
    assert summarise_spread([5.0])["std"] is None and summarise_spread([5.0])["mean"] == 5.0
    assert summarise_spread([5.0, None])["mean"] is None and summarise_spread([])["mean"] is None


def test_means_over_the_scenes_that_compare():
    """Over all of them or none; spread over seeds where these are the same; those of a data set by its name."""
    other = [run | {"seed": run["seed"] + 5} for run in set_runs("brick") if run["config"] == "fast"]
    runs = [*set_runs(), *(run for run in set_runs("brick") if run["config"] == "adc"), *other]
    runs[2] = runs[2] | {"iterations": {"30": runs[2]["iterations"]["30"] | {"gaussians": None}}}
    adc, fast = average_scenes(summarise(mark_apart(runs)))  # and `small` is of one scene
    assert (adc["scene"], adc["config"], adc["scenes"], adc["seeds"]) == ("mean of 2 scenes", "adc", 2, [0, 1])
    assert adc["PSNR"] == summarise_spread([31.0, 31.4]) and fast["seeds"] == [None] and fast["PSNR"]["mean"] == 32.2
    assert fast["PSNR"]["std"] is None and fast["gaussians"]["mean"] is None
    (table,) = make_result_tables([adc, fast])
    assert table.rows[0][:4] == ["mean of 2 scenes", "adc", "30", "31.20 ± 0.28"] and table.rows[1][-1] == "-"
    runs[-2:] = [run | {"ground_truth_sha256": "b" * 64} for run in runs[-2:]]  # `fast` of a scene
    assert [mean["config"] for mean in average_scenes(summarise(mark_apart(runs)))] == ["adc"]
    tanks = [run | {"group": "tanksandtemples"} for name in ("truck", "train") for run in set_runs(name)]
    assert {mean["scene"] for mean in average_scenes(summarise(tanks))} == {"mean of tanksandtemples"}
    part = [run | {"group": "mipnerf360", "open_ended": True} for name in ("garden", "room") for run in set_runs(name)]
    (mean, *_) = average_scenes(summarise(part))
    assert mean["scene"] == "mean of 2 scenes of mipnerf360" and mean["iteration"] is None


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
    marked = mark_apart(runs)
    assert {run["config"] for run in marked if run["apart"]} >= {"small"}
    assert marked[-1]["why_apart"] == why and marked[0]["why_apart"] is None
    report = make_report(["full_eval.py"], runs)
    assert "small" not in str(report["gains"])
    _, table = make_result_tables(report["summary"])
    assert f"attic, small: {why}." in table.title and "small" in [row[1] for row in table.rows]


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
    (table,) = make_result_tables(rows)
    assert dict(zip(table.header, table.rows[-1], strict=True))["iteration"] == "20 to 40"


def test_published_scenes_add_up_to_the_published_means():
    """Two tables of the paper were transcribed by hand: each mean over scenes must be the printed mean."""
    table = read_published()[0]
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


def test_shipped_sets_are_options_of_training(tmp_path, monkeypatch):
    assert "strategies" in list_shipped()
    guide = (ROOT / "docs" / "guide" / "many_scenes.md").read_text().splitlines()
    described = {name for line in guide if line.startswith("| `") for name in line.split("|")[1].split("`")[1::2]}
    for name in list_shipped():
        sets = read_configs(Path(name), train.parse)
        assert len(sets) > 1 and set(sets) <= described, "many_scenes.md does not tell what these are for"
    assert (
        choose_default_set(read_configs(Path("strategies"), None))
        == "adc"
        == choose_default_set({"defaults": [], "adc": []})
    )
    assert (
        choose_default_set({"fast": [], "defaults": []}) == "defaults" and choose_default_set({"x": [], "y": []}) == "x"
    )
    assert read_configs(Path("strategies"), None)["adc"] == ()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "strategies").write_text(json.dumps({"mine": []}))  # a file comes first
    assert list(read_configs(Path("strategies"), None)) == ["mine"]
    with pytest.raises(UserError, match="cannot read strategy .*or strategies"):
        read_configs(Path("strategy"), None)
