"""Runs beside each other: spread, option sets, published tables, and the tables of them."""

import csv
import io
import json
import re
import statistics
from pathlib import Path
from statistics import fmean

import numpy as np
import pytest
from report_runs import run_of, set_runs
from scipy import stats

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
from applications.evaluation.gains import compute_gains, compute_interval, correct_holm, judge_gain
from applications.evaluation.paper import format_csv, format_tex
from applications.evaluation.plan import DATASETS
from applications.evaluation.report import make_report
from applications.evaluation.tables import make_gains_table, make_result_tables
from utils.system_utils import UserError


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


@pytest.mark.parametrize(("change", "why"), [
    ({"test_sizes": [[48, 32]], "options": ["-r", "2", "--sh_degree", "1"]},
     "its test views have 48x32 pixels, the others' 96x64; -r 2 instead of the defaults"),
    ({"options": ["--masks", "foreground"]},
     "the pixels of its test views differ, or which of them count; --masks foreground instead of the defaults"),
    ({"views": {"test": 3, "train": 6}}, "it has 3 test views, the others 2"),
    ({"ground_truth_sha256": None}, "its ground truth is not known"),
])  # fmt: skip
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
    for name in list_shipped():
        assert len(read_configs(Path(name), train.parse)) > 1
    strategies = read_configs(Path("strategies"), None)
    for sets, default in ((strategies, "adc"), ({"defaults": [], "adc": []}, "adc"), ({"x": [], "y": []}, "x")):
        assert choose_default_set(sets) == default
    assert choose_default_set({"fast": [], "defaults": []}) == "defaults" and strategies["adc"] == ()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "strategies").write_text(json.dumps({"mine": []}))  # a file comes first
    assert list(read_configs(Path("strategies"), None)) == ["mine"]
    with pytest.raises(UserError, match="cannot read strategy .*or strategies"):
        read_configs(Path("strategy"), None)


def test_intervals_are_those_of_a_paired_t_test():
    random = np.random.default_rng(0)
    for _ in range(5):
        one, other = random.normal(30, 1, 7), random.normal(30.2, 1, 7)
        found, test = compute_interval((one - other).tolist()), stats.ttest_rel(one, other)
        bounds = test.confidence_interval(0.95)
        assert (found["p"], found["mean"] - found["half"]) == pytest.approx((test.pvalue, bounds.low))
        assert found["mean"] + found["half"] == pytest.approx(bounds.high)


def test_holms_correction():
    """By hand: the smallest times 4, the next times 3, and never less than the one before."""
    assert correct_holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert correct_holm([]) == [] and correct_holm([0.7]) == [0.7] and correct_holm([0.6, 0.9]) == [1.0, 1.0]


def test_verdicts():
    for differences, said in (
        ([0.5, 0.6, 0.55, 0.5], "gains"), ([-0.5, -0.6, -0.55], "costs"), ([0.0, 0.0], "same scores"),
        ([0.02, -0.03, 0.01, 0.0, 0.02, -0.02], "no difference above 0.02 dB"),
        ([0.5, -0.6, 0.4], "not decided"), ([0.1, 0.1], "gains"),
    ):  # fmt: skip
        assert judge_gain(compute_interval(differences)) == said


def _runs(scene: str, **ends: list[float]) -> list[dict]:
    every = [(name, seed, end) for name, values in ends.items() for seed, end in enumerate(values)]
    return [run_of(name, seed, (1, 20.0, 10), (2, end, 10), scene=scene) for name, seed, end in every]


def test_seeds_are_paired_and_scenes_corrected_together():
    base, better = [30.0, 31.0, 29.0], [30.5, 31.52, 29.54]
    runs = _runs("attic", none=base, option=better, single=base[:1])
    runs += _runs("barn", none=base, option=[30.1, 30.9, 29.1])
    found = compute_gains(runs)
    assert found["attic"]["default"] == "none" and list(found["attic"]["sets"]) == ["option"]
    row = found["attic"]["sets"]["option"]
    alone = compute_interval([0.5, 0.52, 0.54])
    assert row["mean"] == pytest.approx(0.52) and row["half"] == pytest.approx(alone["half"])
    assert row["p"] == pytest.approx(2 * alone["p"]) and row["verdict"] == "gains" and row["seeds"] == 3
    assert make_gains_table(found["attic"]).rows == [["option", "3", "+0.52 ± 0.05", "gains"]]
    assert not compute_gains(_runs("attic", none=base)) and not compute_gains(
        _runs("attic", none=[30.0], option=[31.0])
    )
    assert make_report(["full_eval.py"], runs)["gains"] == found


def test_a_row_for_each_run_and_for_each_mean():
    failed = run_of("adc", 2, (10, 20.0, 100)) | {"failure": {"stage": "train"}, "iterations": {}}
    both = run_of("one, two", 0, (10, 20.0, 100), (20, 21.0, 200))
    both["iterations"] |= {"10": both["iterations"]["20"] | {"PSNR": 20.5, "ply_mb": None}, "15": {"views": 0}}
    report = make_report(["x"], [*set_runs("attic"), *set_runs("brick"), failed, both])
    rows = list(csv.DictReader(io.StringIO(format_csv(report))))
    assert {len(row) for row in rows} == {26} and len(rows) == 12 + 1 + 2 + 3

    def of(row: dict, *names: str) -> list[str]:
        return [row[name] for name in names]

    runs, means = [row for row in rows if row["scenes"] == "1"], [row for row in rows if row["scenes"] == "2"]
    assert of(runs[0], "group", "scene", "config", "seed") == ["scenes", "attic", "adc", "0"]
    assert of(runs[0], "PSNR", "gaussians", "LPIPS", "failed") == ["31.0", "300", "", ""]
    assert of(means[0], "scene", "config", "seed", "model") == ["mean of 2 scenes", "adc", "", ""]
    of_adc = [float(row["PSNR"]) for row in runs if row["config"] == "adc" and not row["failed"]]
    assert len(of_adc) == 4 and float(means[0]["PSNR"]) == fmean(of_adc)
    assert [of(row, "failed", "seed", "PSNR", "iteration") for row in runs if row["failed"]] == [["train", "2", "", ""]]
    twice = [of(row, "iteration", "PSNR", "ply_mb") for row in runs if row["config"] == "one, two"]
    assert sorted(twice) == [["10", "20.5", ""], ["20", "21.0", "0.02"]]


def test_tables_that_tex_reads():
    """By TeX's rules; pdflatex compiled the same in an article, with the package booktabs and without."""
    name = "a--b_% #&$~^{x} <é>|\n地\\\udce9"
    other = run_of(name, 1, (10, 20.0, 100), scene="brick", ground_truth_sha256="b" * 64)
    text = format_tex(make_report(["x"], [*set_runs("attic"), *set_runs("brick"), other]))
    assert text.replace("é", "").isascii() and "\n\n" not in text and "--" not in text
    assert text.count("{") - text.count(r"\{") == text.count("}") - text.count(r"\}")
    main, apart = re.findall(r"\\begin\{table\}.*?\\end\{table\}", text, re.DOTALL)
    columns = re.search(r"\\begin\{tabular\}\{(\w+)\}", main)[1]
    lines = [line for line in main.splitlines() if line.endswith(r" \\")]
    heads = [line for line in lines if line.startswith(f"\\multicolumn{{{len(columns)}}}{{l}}")]
    assert [re.search(r"\{([^}]*)\} \\", line)[1] for line in heads] == ["attic", "brick", "mean of 2 scenes"]
    assert lines.index(heads[0]) == 1 and lines.index(heads[2]) == 9 and len(lines) == 1 + 3 + 9
    assert {line.count(" & ") for line in lines if line not in heads} == {len(columns) - 1}
    assert lines[0].startswith(r"options & PSNR (dB) & SSIM & training (s) & Gaussians")
    assert lines[2].startswith(r"adc & 31.20 $\pm$ 0.28 & - &") == lines[10].startswith(r"adc & 31.20 $\pm$ 0.28 & - &")
    assert main.count("\\midrule\n") == 3 and "test views, iteration 30, seeds 0 1. Means" in main
    escaped = r"a-{}-b\_\% \#\&\$\textasciitilde{}\textasciicircum{}\{x\} $<$é$>$$|$ \textbackslash{}u5730"
    assert f"\n{escaped}\\textbackslash{{}}\\textbackslash{{}}udce9 & 20.00 &" in apart
    assert "Scored on other ground truth, so not to be compared with other rows." in apart
