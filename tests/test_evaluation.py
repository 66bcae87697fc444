"""The evaluation's arithmetic: spread, Pareto front, cheapest option sets, published tables."""

import ast
import statistics
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from splatting.evaluation import published
from splatting.evaluation.error_curve import COLUMNS
from splatting.evaluation.option_sets import cheapest, gaussians_to_reach, pareto_front, seconds_to_reach
from splatting.evaluation.results_page import BEGIN, END, replace_results, results_text
from splatting.evaluation.scenes import DATASETS
from splatting.evaluation.summary import QUANTITIES, spread, summarise
from splatting.evaluation.what_to_try import peak
from splatting.files.markdown_table import markdown_table
from utils.system_utils import UserError


def curve(*points: tuple[float, float | None, float]) -> list[dict]:
    """Rows of (seconds, test PSNR, Gaussians)."""
    return [
        dict.fromkeys(COLUMNS) | {"iteration": i, "seconds": s, "test_psnr": p, "gaussians": n}
        for i, (s, p, n) in enumerate(points, 1)
    ]


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), max_size=30))
def test_pareto_front_is_what_nothing_beats(points):
    front = pareto_front(points)

    def beaten(point):
        return any(q != point and q[0] <= point[0] and q[1] <= point[1] for q in points)

    assert {points[i] for i in front} == {point for point in points if not beaten(point)}
    assert len({points[i] for i in front}) == len(front) and front == sorted(front, key=lambda i: points[i])


def test_seconds_to_reach_between_points():
    rows = curve((1, 10, 100), (100, 20, 300), (200, 19, 250), (300, 30, 400))
    assert seconds_to_reach(rows, 9) == 1
    assert seconds_to_reach(rows, 20) == 100
    assert seconds_to_reach(rows, 15) == 100  # too far from the point before to interpolate
    assert seconds_to_reach(rows, 24.5) == pytest.approx((200 * 300) ** 0.5)  # halfway in the logarithm
    assert seconds_to_reach(rows, 31) is None
    assert gaussians_to_reach(rows, 20) == 300 and gaussians_to_reach(rows, 18) == 250
    assert gaussians_to_reach(rows, 31) is None


def test_cheapest_wants_every_seed_and_takes_the_mean():
    sets = {
        "slow": [curve((10, 20, 50), (100, 30.07, 60)), curve((10, 20, 50), (100, 30.07, 60))],
        "fast": [curve((1, 20, 80), (2, 29, 90)), curve((3, 20, 70), (30, 28, 90))],
    }
    curves = {name: [{"curve": rows} for rows in seeds] for name, seeds in sets.items()}
    rows = {row["psnr"]: row for row in cheapest(curves)}
    assert cheapest({}) == [] == cheapest({"a": [{"curve": []}], "b": [{"curve": curve((1, None, 2))}]})
    assert list(rows) == [30.0, 29.9, 29.8, 29.5, 29.0, 28.0, 27.0, 25.0, 22.0]
    assert rows[29.0]["seconds"]["config"] == "slow" and set(rows[29.0]["seconds"]["all"]) == {"slow"}
    assert rows[28.0]["seconds"]["config"] == "fast" and set(rows[28.0]["seconds"]["all"]) == {"slow", "fast"}
    assert rows[28.0]["seconds"]["value"] == pytest.approx((2 ** (8 / 9) + 30) / 2)
    assert rows[28.0]["seconds"]["std"] == pytest.approx((30 - 2 ** (8 / 9)) / 2**0.5)
    assert rows[28.0]["gaussians"] == {"all": {"slow": 60, "fast": 90}, "config": "slow", "std": 0.0, "value": 60}


def test_subsets_are_no_peak():
    part = [row | {"subset": 2} for row in curve((1, 35, 10), (2, 36, 10))]
    whole = [row | {"iteration": row["iteration"] + 2} for row in curve((3, 20, 10), (4, 20.05, 10))]
    late = [row | {"iteration": 9, "subset": 2, "test_psnr": 1.0} for row in part[:1]]
    assert peak(part + whole + late) is peak(part + whole[::-1]) is peak(part) is None  # 0.05 dB is not clear
    best, lost = peak([*part, *whole, whole[0] | {"iteration": 8, "test_psnr": 19.0}])
    assert best["iteration"] == 4 and lost == pytest.approx(1.05)


def test_spread():
    assert spread([1.0, 2.0, 4.0]) == {
        "mean": pytest.approx(7 / 3), "std": pytest.approx(statistics.stdev([1, 2, 4])), "values": [1.0, 2.0, 4.0],
    }  # fmt: skip
    assert spread([5.0])["std"] is None and spread([5.0])["mean"] == 5.0
    assert spread([5.0, None])["mean"] is None and spread([])["mean"] is None


def test_a_failed_seed_is_left_out_and_named():
    def run(seed, failure):
        values = dict.fromkeys(QUANTITIES, 1.0 + seed) | {"views": 3}
        return {"scene": "a", "group": "scenes", "config": None, "seed": seed, "failure": failure,
                "iterations": {"10": values}, "ground_truth_sha256": "x", "apart": False,
                "open_ended": False}  # fmt: skip

    (row,) = summarise([run(0, None), run(1, {"stage": "train"}), run(2, None)])
    assert row["PSNR"] == {"mean": 2.0, "std": pytest.approx(2**0.5), "values": [1.0, 3.0]}
    assert row["seeds"] == [0, 2] and row["failed_seeds"] == [1]


def test_published_scenes_add_up_to_the_published_means():
    """Two tables of the paper were transcribed by hand: each mean over scenes must be the printed mean."""
    table = published.published_tables()[0]
    assert set(table["scenes"]) == {name for scenes in DATASETS.values() for name in scenes}
    for group, by_iteration in table["means"].items():
        for iteration, means in by_iteration.items():
            for metric, half in (("PSNR", 0.005), ("SSIM", 0.0005), ("LPIPS", 0.0005)):
                mean = statistics.fmean(table["scenes"][name][iteration][metric] for name in DATASETS[group])
                # The mean is rounded, and so are the numbers that it is computed from here.
                assert abs(mean - means[metric]) <= 1.5 * half + 1e-12, (group, iteration, metric)


def _blender_run(**change):
    run = {"scene": "lego", "config": None, "group": "scenes", "added_options": [], "options": ["--eval", "-w"],
           "test_sizes": [[800, 800]], "views": {"test": 200, "train": 100}}  # fmt: skip
    row = {"scene": "lego", "config": None, "group": "scenes", "iteration": 30000, "open_ended": False}
    row |= {name: spread([35.0 if name == "PSNR" else 0.5]) for name in QUANTITIES}
    return published.compare([run | change], [row], [])


def test_synthetic_scenes_compare_at_full_size_over_white_only():
    (found,) = _blender_run()
    assert found["numbers"] == {"PSNR": {"ours": 35.0, "published": 35.78, "difference": pytest.approx(-0.78)}}
    assert not _blender_run(test_sizes=[[400, 400]])
    assert not _blender_run(views={"test": 25, "train": 100})
    assert not _blender_run(options=["--eval"])


def test_markdown_keeps_columns_apart():
    table = ["a", "b"], [["x|y", "1"], ["z", "22"]]
    assert markdown_table(*table).splitlines() == [
        "| a    |   b |", "| ---- | --: |", "| x\\|y |   1 |", "| z    |  22 |",
    ]  # fmt: skip
    assert markdown_table(*table, right=False).splitlines() == [
        "| a    | b   |", "| ---- | --- |", "| x\\|y | 1   |", "| z    | 22  |",
    ]  # fmt: skip


def test_nothing_imports_the_benchmarks():
    """The benchmarks measure the project, which must run without them."""
    root = Path(__file__).parents[1]
    outside = ("benchmarks", "tests", "build", "output")
    folders = [path for path in root.iterdir() if path.name not in outside and not path.name.startswith(".")]
    ours = [file for path in folders for file in ([path] if path.suffix == ".py" else path.glob("**/*.py"))]
    assert len(ours) > 100
    for path in ours:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            assert not [name for name in names if name.split(".")[0] == "benchmarks"], path


@pytest.mark.parametrize("text", ["", BEGIN, f"{END}\n{BEGIN}", f"{BEGIN}{BEGIN}{END}"])
def test_a_page_without_marks_is_left_alone(text):
    with pytest.raises(UserError, match="one line <!-- results: begin"):
        replace_results(text, [])


@pytest.mark.parametrize(
    ("sets", "text"),
    [
        ({None: ["--iterations", "40"]}, "Options of every run: `--iterations 40`."),
        ({"base": ["--iterations", "40"], "long": ["--iterations", "50"]},
         "Each option set adds:\n\n- base: `--iterations 40`\n- long: `--iterations 50`"),
        ({"base": ["--test_iterations", "-1", "-w"], "sh1": ["--test_iterations", "-1", "-w", "--sh_degree", "1"]},
         "Options of every run: `--test_iterations -1 -w`.\n\nEach option set adds:\n\n- base: nothing\n"
         "- sh1: `--sh_degree 1`"),
    ],
)  # fmt: skip
def test_options_that_all_runs_share_are_written_once(sets, text):
    runs = [{"config": name, "added_options": words, "machine": None} for name, words in sets.items()]
    _, written = results_text({"summary": [], "runs": runs}).split("\n\n", 1)
    assert written == text
