"""error_vs_time.csv and .png: the file, the schedule, the scores, the figure; training stays the same with them."""

import csv
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image
from plyfile import PlyData
from skimage.metrics import peak_signal_noise_ratio

import render
import train
from gaussian_renderer.scored_views import ScoredViews, mean_scores
from records.curve_figure import draw_curve
from records.curve_peak import peak_advice, schedules_follow_length
from records.curve_recorder import CurveRecorder, drawn, evenly_spread
from records.curve_schedule import CurveSchedule, subset_size
from records.error_curve import COLUMNS, Row, best_test, continue_curve, read_curve, whole_sets, write_curve
from records.training_log import TrainingLog
from training import objective
from training.observers.report import Report
from utils.host import process
from utils.loss_utils import ssim
from utils.system_utils import UserError

ROOT = Path(__file__).parents[1]
HEADER = (
    "iteration,seconds,wall_seconds,gaussians,peak_memory_mib,"
    "test_l1,test_psnr,test_ssim,train_l1,train_psnr,train_ssim,subset\n"
)
OLD = HEADER.replace(",subset", "")  # of files without subsets


@pytest.fixture(autouse=True)
def _stdout(monkeypatch: pytest.MonkeyPatch) -> None:
    """Restore stdout, which training stamps and may silence."""
    monkeypatch.setattr(sys, "stdout", sys.stdout)


def _row(iteration: int, test: float | None, train: float | None = None, **more: float | None) -> Row:
    row = dict.fromkeys(COLUMNS) | {"iteration": iteration, "seconds": iteration / 10, "wall_seconds": iteration / 9}
    return row | {"test_psnr": test, "train_psnr": train} | more


def _train(scene: Path, out: Path, *more: object, iterations: int) -> str:
    train.main(["-s", str(scene), "-m", str(out), "--eval", "--iterations", str(iterations), "-r", "32",
                "--test_iterations", "-1", *map(str, more)])  # fmt: skip
    return (out / "point_cloud" / f"iteration_{iterations}" / "point_cloud.ply").read_bytes()


def _iterations(out: Path) -> list[int]:
    return [row["iteration"] for row in read_curve(out / "error_vs_time.csv")]


class TestFile:
    def test_header_and_empty_fields(self, tmp_path):
        path = tmp_path / "error_vs_time.csv"
        rows = [_row(3, 20.25, math.inf, gaussians=7), _row(5, math.nan, test_l1=0.125)]
        write_curve(path, rows)
        assert (
            path.read_text()
            == HEADER + "3,0.3,0.3333333333333333,7,,,20.25,,,,,\n5,0.5,0.5555555555555556,,,0.125,,,,,,\n"
        )
        assert read_curve(path) == [_row(3, 20.25, None, gaussians=7), _row(5, None, test_l1=0.125)]
        with path.open(newline="") as file:
            assert len(list(csv.DictReader(file))) == 2

    @pytest.mark.parametrize(
        "content",
        [
            b"",
            b"iteration,seconds\n1,2\n",
            HEADER.encode() + b"3,0.3\n",
            HEADER.encode() + b"x,0.3,,,,,,,,,,\n",
            HEADER.encode() + b"3,,,,,,,,,,,\n",
            HEADER.encode() + b",0.3,,,,,,,,,,\n",
            HEADER.encode() + b"3,0.3,,,,,nan,,,,,\n",
            HEADER.encode() + b"3,0.3,,,,,,,,,,1.5\n",
            HEADER.encode() + b"3,0.3,,,,,,,,,\n",  # a line of an older file
            HEADER.encode() + b"3,0.3,,,,,,,,,,\n3,0.4,,,,,,,,,,\n",
            b"\xff\xfe\x00",
        ],
    )
    def test_damage(self, tmp_path, capsys, content):
        path = tmp_path / "error_vs_time.csv"
        path.write_bytes(content)
        with pytest.raises(UserError, match="error_vs_time.csv cannot be read as a curve"):
            read_curve(path)
        assert continue_curve(tmp_path, 5) == []
        assert re.fullmatch(r"warning: .*error_vs_time.csv cannot be read .*\n", capsys.readouterr().err)
        assert not path.exists()

    def test_files_without_subsets_are_read_and_continued(self, tmp_path):
        path = tmp_path / "error_vs_time.csv"
        path.write_text(OLD + "3,0.3,0.4,7,,,20.25,,,,\n5,0.5,0.6,7,,,21.25,,,,\n")
        wanted = [_row(3, 20.25, gaussians=7, wall_seconds=0.4), _row(5, 21.25, gaussians=7, wall_seconds=0.6)]
        assert read_curve(path) == wanted and whole_sets(wanted) == wanted
        assert continue_curve(tmp_path, 4) == wanted[:1]
        assert path.read_text() == HEADER + "3,0.3,0.4,7,,,20.25,,,,,\n"

    def test_absent(self, tmp_path):
        with pytest.raises(UserError, match="--eval"):
            read_curve(tmp_path / "error_vs_time.csv")
        assert continue_curve(tmp_path, 5) == []

    def test_what_a_run_goes_on_from(self, tmp_path):
        path, figure = tmp_path / "error_vs_time.csv", tmp_path / "error_vs_time.png"
        rows = [_row(2, 10.0), _row(5, 11.0), _row(6, 12.0)]
        write_curve(path, rows)
        figure.write_bytes(b"old")
        assert continue_curve(tmp_path, 5) == rows[:2]
        assert read_curve(path) == rows[:2] and not figure.exists()
        assert continue_curve(tmp_path, 0) == []
        assert not path.exists()


def _simulate(schedule: CurveSchedule, first: int, last: int, pace, cost) -> tuple[list[int], float, float]:
    """Scored iterations and seconds of scoring and of training, if an iteration takes pace(t) and a scoring cost(t)."""
    points, seconds = [], 0.0
    for iteration in range(first + 1, last + 1):
        seconds += pace(iteration)
        if schedule.due(iteration, seconds):
            points.append(iteration)
            schedule.scored(iteration, cost(iteration, schedule.whole(iteration)))
    return points, schedule.spent, seconds


class TestSchedule:
    def test_cheap_points_are_evenly_spaced_in_log_time(self):
        points, _, _ = _simulate(CurveSchedule(0, 30_000, [], 1, 1), 0, 30_000, lambda t: 1.0, lambda *_: 1e-4)
        assert points[0] == round(30_000 / 256) and points[-1] == 30_000 and len(points) == 33
        # Iterations are whole numbers, so a ratio can be off by 1 / 117.
        np.testing.assert_allclose(np.divide(points[1:], points[:-1]), 2**0.25, rtol=1 / 117)

    @pytest.mark.parametrize("views", [1, 2, 7, 25, 200])
    @pytest.mark.parametrize("growth", [-0.75, 0.0, 1.0, 30.0])
    @pytest.mark.parametrize("iterations", [200, 600, 2000, 30_000])
    def test_twelve_points_within_five_percent(self, views, growth, iterations):
        """views: of a set. The whole sets at the end, and a view of each set between, are taken at any cost."""

        def pace(t: int) -> float:  # models grow, most of it in the first half; from random points they shrink
            return 0.01 * (1 + growth * min(1.0, 2 * t / iterations))

        size = subset_size(iterations, 1, 2, views)
        assert 1 <= size <= views

        def cost(t: int, whole: bool) -> float:  # of a view 0.46 iterations, as measured on a CPU
            return 0.46 * 2 * (views if whole else size) * pace(t)

        schedule = CurveSchedule(0, iterations, [], 2 * views, 2 * size)
        points, spent, seconds = _simulate(schedule, 0, iterations, pace, cost)
        assert points[-1] == iterations and len(points) >= 12
        assert set(points) <= {round(iterations * 2 ** (-k / 4)) for k in range(33)}
        sure = {round(iterations * 2 ** (-k / 2)) for k in range(1, 13)}
        least = cost(iterations, True) + sum(0.46 * 2 * pace(t) for t in sure)
        assert spent < max(0.05 * seconds, 1.05 * least)

    def test_the_subset_takes_what_the_budget_leaves(self):
        assert subset_size(30_000, 3, 2, 25) == 25  # all: every point is whole
        assert subset_size(2000, 1, 2, 25) == 2
        assert subset_size(2000, 1, 2, 3) == 3
        assert subset_size(600, 1, 2, 25) == subset_size(1, 1, 2, 25) == 1
        assert subset_size(12_000, 1, 2, 200) == 13

    def test_a_dear_first_scoring_does_not_end_the_curve(self):
        schedule = CurveSchedule(0, 2000, [], 14, 14)
        points, _, _ = _simulate(schedule, 0, 2000, lambda t: 0.01, lambda t, _: 0.4 if t < 20 else 0.02)
        assert len(points) > 13

    def test_what_must_be_scored_is(self):
        always = [-1, 7, 90, 3000]
        for last, sure in ((100, []), (400, [6, 9, 12, 18, 25, 35, 50, 71, 100, 141, 200, 283])):
            for first in (0, 50):
                schedule = CurveSchedule(first, last, always, 10_000, 2)
                points, _, _ = _simulate(schedule, first, last, lambda t: 1.0, lambda *_: 5000.0)
                assert points == [t for t in sorted([*sure, 7, 90, last]) if t > first]
                assert [t for t in points if schedule.whole(t)] == [t for t in (7, 90, last) if t > first]
        points, _, _ = _simulate(CurveSchedule(0, 1, [-1], 2, 2), 0, 1, lambda t: 1.0, lambda *_: 1.0)
        assert points == [1]

    def test_a_resumed_run_has_the_points_ahead(self):
        whole, _, _ = _simulate(CurveSchedule(0, 1000, [], 1, 1), 0, 1000, lambda t: 1.0, lambda *_: 1e-4)
        resumed, _, _ = _simulate(CurveSchedule(400, 1000, [], 1, 1), 400, 1000, lambda t: 1.0, lambda *_: 1e-4)
        assert resumed == [t for t in whole if t > 400]


class TestScores:
    def test_against_others(self):
        generator = torch.Generator().manual_seed(0)
        renders = [torch.rand(3, 20, 30, generator=generator) for _ in range(2)]
        targets = [(r + 0.1 * torch.randn(r.shape, generator=generator)).clamp(0, 1) for r in renders]
        targets = [(t * 255).round().to(torch.uint8) for t in targets]
        truths = [t.double().numpy() / 255 for t in targets]
        means = mean_scores(zip(renders, targets, (None, None), strict=True))
        psnrs = [
            peak_signal_noise_ratio(t, r.double().numpy(), data_range=1.0) for t, r in zip(truths, renders, strict=True)
        ]
        l1s = [np.abs(t - r.double().numpy()).mean() for t, r in zip(truths, renders, strict=True)]
        ssims = [ssim(r.double(), torch.from_numpy(t)).item() for t, r in zip(truths, renders, strict=True)]
        assert list(means) == ["l1", "psnr", "ssim"]
        # float32 sums of 1,800 terms: relative errors far below 1e-5, and 1e-5 of the error is 4e-5 dB.
        assert means["l1"] == pytest.approx(np.mean(l1s), rel=1e-5)
        assert means["psnr"] == pytest.approx(np.mean(psnrs), abs=1e-4)
        assert means["ssim"] == pytest.approx(np.mean(ssims), abs=1e-5)

    def test_equal_images_and_no_images(self):
        image = torch.full((3, 12, 12), 51 / 255)
        means = mean_scores([(image, torch.full((3, 12, 12), 51, dtype=torch.uint8), None), (image, image * 0, None)])
        assert means["psnr"] == math.inf and means["l1"] == pytest.approx(0.1)
        assert mean_scores([]) == {}

    def test_masks(self):
        """A mask without a rim gives the scores of views without the rim; SSIM is tested with the loss."""
        generator = torch.Generator().manual_seed(0)
        image, target = torch.rand(2, 3, 20, 30, generator=generator)
        mask = torch.zeros(1, 20, 30, dtype=torch.bool)
        mask[:, 4:, :20] = True
        means = mean_scores([(image, target, mask), (image, target, torch.zeros_like(mask))])
        inside = mean_scores([(image[:, 4:, :20], target[:, 4:, :20], None)])
        assert means["l1"] == pytest.approx(inside["l1"], rel=1e-5)
        assert means["psnr"] == pytest.approx(inside["psnr"], abs=1e-4)
        assert means["ssim"] != pytest.approx(mean_scores([(image, target, None)])["ssim"], abs=1e-3)

    def test_pictures_and_masks_are_loaded_before_a_scoring_is_timed(self, tmp_path):
        seen = []

        def load(views: list[str]) -> None:
            seen.append(("load", *views))

        def scores(views: list[str]) -> dict[str, float]:
            seen.append(("scores", *views))
            return {"psnr": 20.0}

        views, log = {"test": ["a"], "train": ["b"]}, TrainingLog(tmp_path, 0)
        recorder = CurveRecorder(tmp_path, [], log, 2, [], views, load, scores, torch.device("cpu"))
        recorder.add(1, 1.0, 5)
        assert seen == [("load", "a", "b"), ("scores", "a"), ("scores", "b")]
        recorder.add(2, 2.0, 5)
        assert seen[3:] == [("scores", "a"), ("scores", "b")]  # loaded once
        assert recorder.rows[0]["test_psnr"] == recorder.rows[1]["train_psnr"] == 20.0

    def test_a_set_is_scored_by_render_target_and_mask_of_each_view(self):
        image = torch.full((3, 12, 12), 0.5)

        class View:
            mask = None
            loaded = 0

            def target(self, background: torch.Tensor) -> torch.Tensor:
                self.loaded += 1
                return image - 0.1

        views = [View(), View()]
        scored = ScoredViews(None, torch.zeros(3), train_test_exp=False, draw=lambda camera, gaussians: image)
        scored.load(views[0])
        assert [view.loaded for view in views] == [1, 0]
        scores = scored.scores(views, None)
        assert scores["l1"] == pytest.approx(0.1) and scores["psnr"] == pytest.approx(20.0, abs=1e-4)

    def test_between_a_fixed_part_of_each_set_is_scored(self, tmp_path):
        seen = []

        def scores(views: list[int]) -> dict[str, float]:
            seen.append(views)
            return {"psnr": 20.0}

        views = {"test": list(range(25)), "train": list(range(100, 125))}
        recorder = CurveRecorder(tmp_path, [], TrainingLog(tmp_path, 0), 2000, [500], views, lambda view: None, scores,
                                 torch.device("cpu"))  # fmt: skip
        for iteration in (250, 500, 1000, 2000):
            recorder.add(iteration, iteration / 10, 5)
        assert [row["subset"] for row in recorder.rows] == [1, None, 1, None]
        assert seen[0] == seen[4] and seen[1] == seen[5] == [100 + view for view in seen[0]]
        assert [len(views) for views in seen] == [1, 1, 25, 25] * 2
        assert read_curve(tmp_path / "error_vs_time.csv") == recorder.rows

    def test_a_part_is_drawn_by_a_seed_of_its_own(self):
        torch.manual_seed(1)
        few = drawn(list("abcdefghijklmnop"), 3)
        assert few == drawn(list("abcdefghijklmnop"), 3) == sorted(few) != list("abc")
        assert set(few) < set(drawn(list("abcdefghijklmnop"), 9))
        assert drawn([1, 2], 5) == [1, 2] and drawn([], 5) == []

    def test_views_are_evenly_spread(self):
        assert evenly_spread(range(9), 3) == [0, 4, 8]
        assert evenly_spread(range(9), 1) == [0]
        assert evenly_spread(range(2), 5) == [0, 1]
        for count in range(1, 40):
            views = evenly_spread(range(40), count)
            assert len(set(views)) == count and max(np.diff([*views, 40])) <= 40 / count + 40 / max(count - 1, 1)


class TestPeak:
    # As in scenes with few views, the test views peak while the training views still improve.
    ROWS = (_row(500, 18.0, 18.5), _row(2000, 20.3, 23.0), _row(4000, 20.1, 26.0), _row(7000, 19.6, 29.0))

    def test_a_peak_before_the_end_is_named(self):
        line = peak_advice(list(self.ROWS), {7000}, 30_000)
        assert line == (
            "Test views were best at iteration 2000: PSNR 20.30 dB, 0.70 dB above the end (train views 23.00 there, "
            "29.00 at the end); --iterations 2000 ends with that model, --save_iterations 2000 also saves it; "
            "--position_lr_max_steps 2000 as well is a different training: its learning rate of positions falls by "
            "then instead of by 30000"
        )
        assert "that model is saved, use it with render.py --iteration 2000" in peak_advice(
            list(self.ROWS), {2000}, 2000
        )

    def test_no_advice_that_a_schedule_of_the_length_makes_untrue(self):
        assert not schedules_follow_length(depths=False, train_test_exp=False)
        assert schedules_follow_length(depths=True, train_test_exp=False)
        assert schedules_follow_length(depths=False, train_test_exp=True)
        assert schedules_follow_length(depths=False, train_test_exp=False, resolution_schedule="pyramid")
        assert schedules_follow_length(depths=False, train_test_exp=False, rates=True)
        line = peak_advice(list(self.ROWS), {7000}, 30_000, follows_length=True)
        assert "ends with that model" not in line
        assert "; --save_iterations 2000 saves that model during the training; --iterations 2000 --position_lr" in line

    def test_a_subset_is_no_peak_and_no_end(self):
        rows = [_row(500, 18.0), _row(1000, 30.0, subset=2), *self.ROWS[1:], _row(7001, 10.0, subset=2)]
        assert peak_advice(rows, {7000}, 30_000) == peak_advice(list(self.ROWS), {7000}, 30_000)
        assert best_test(rows)["iteration"] == 2000 and len(whole_sets(rows)) == 4
        assert best_test([_row(1000, 30.0, subset=2)]) is None

    def test_no_peak_no_advice(self):
        assert peak_advice(list(self.ROWS[:2]), (), 30_000) is None
        assert peak_advice([_row(5, 20.09), _row(7, 20.0)], (), 30_000) is None
        assert peak_advice([_row(5, 20.2), _row(7, 20.0)], (), 5).count("PSNR") == 1
        assert peak_advice([_row(7, None)], (), 30_000) is None
        assert peak_advice([_row(5, 20.0), _row(7, None)], (), 30_000) is None
        assert best_test([_row(5, None), _row(6, 3.0), _row(7, 3.0)])["iteration"] == 6

    def test_the_advice_gives_the_model_that_was_scored(self, colmap_scene, tmp_path):
        options = [
            "--densify_from_iter",
            5,
            "--densification_interval",
            10,
            "--densify_grad_threshold",
            1e-5,
            "--no_curve",
            "--prune_sh",
            -1,
        ]
        _train(colmap_scene, tmp_path / "long", *options, "--save_iterations", 20, iterations=40)
        short = _train(colmap_scene, tmp_path / "short", *options, iterations=20)
        assert (tmp_path / "long/point_cloud/iteration_20/point_cloud.ply").read_bytes() == short
        assert PlyData.read(tmp_path / "short/point_cloud/iteration_20/point_cloud.ply")["vertex"].count > 300


class TestFigure:
    def test_what_is_drawn(self, tmp_path, monkeypatch):
        figures = []
        plain = Figure.savefig
        monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (figures.append(self), plain(self, *a, **k)))
        scores = {"test_ssim": 0.75, "train_ssim": 0.875}
        rows = [_row(10, 10.0, 11.0, **scores), _row(20, 15.0, None, **scores), _row(40, 14.0, 20.0, **scores)]
        draw_curve(tmp_path / "error_vs_time.png", rows, "a model")
        with Image.open(tmp_path / "error_vs_time.png") as image:
            assert min(image.size) > 400 and len(image.convert("RGB").getcolors(10**6)) > 10
        upper, lower = figures[0].axes
        assert upper.get_xscale() == lower.get_xscale() == lower.get_yscale() == "log"
        drawn = {line.get_label(): line.get_xydata().tolist() for line in upper.lines}
        assert drawn["test views"] == [[1, 10], [2, 15], [4, 14]]
        assert drawn["train views"] == [[1, 11], [4, 20]]
        assert drawn["best test: 15.00 dB, iteration 20"] == [[2, 15]]
        assert [line.get_ydata().tolist() for line in lower.lines] == [[0.25] * 3, [0.125] * 3]
        legends = [text.get_text() for axes in (upper, lower) for text in axes.get_legend().get_texts()]
        assert "gap, 6 dB at the end" in legends and "gap, 0.125 at the end" in legends

    def test_subsets_are_hollow_on_a_line_of_their_own(self, tmp_path, monkeypatch):
        figures = []
        plain = Figure.savefig
        monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (figures.append(self), plain(self, *a, **k)))
        part = {"subset": 4, "test_ssim": 0.5, "train_ssim": 0.5}
        rows = [_row(10, 30.0, 31.0, **part), _row(20, 12.0, 13.0, **part), _row(40, 14.0, 20.0)]
        draw_curve(tmp_path / "error_vs_time.png", rows, "")
        lines = {line.get_label(): line for line in figures[0].axes[0].lines}
        assert lines["test views, 4 of them"].get_xydata().tolist() == [[1, 30], [2, 12]]
        assert lines["test views"].get_xydata().tolist() == [[4, 14]]
        assert lines["test views, 4 of them"].get_fillstyle() == "none" != lines["test views"].get_fillstyle()
        assert lines["best test: 14.00 dB, iteration 40"].get_xydata().tolist() == [[4, 14]]

    @pytest.mark.parametrize(
        "rows", [[], [_row(1, None)], [_row(1, 5.0)], [_row(1, 5.0, test_ssim=1.0, train_ssim=1.0)]]
    )
    @pytest.mark.filterwarnings("error")
    def test_little_to_draw(self, tmp_path, rows):
        draw_curve(tmp_path / "error_vs_time.png", rows, "")
        assert (tmp_path / "error_vs_time.png").stat().st_size > 1000


class TestTraining:
    def test_no_bit_of_the_model_changes(self, colmap_scene, tmp_path, capfd):
        options = ["--densify_from_iter", 10, "--densification_interval", 20, "--densify_grad_threshold", 1e-5,
                   "--opacity_reset_interval", 45, "--random_background", "--images_to_load", 3]  # fmt: skip
        with_curve = _train(colmap_scene, tmp_path / "with", *options, "--test_iterations", 9, 30, iterations=80)
        said = capfd.readouterr().out
        line = re.search(r"^Curve of (\d+) points, scored in [\d.]+ s \([\d.]+ % of the training\)", said, re.MULTILINE)
        assert int(line[1]) == len(_iterations(tmp_path / "with"))
        without = _train(colmap_scene, tmp_path / "without", *options, "--no_curve", iterations=80)
        assert with_curve == without
        assert len(PlyData.read(tmp_path / "with/point_cloud/iteration_80/point_cloud.ply")["vertex"]) > 300
        assert {9, 30, 80} <= set(_iterations(tmp_path / "with"))
        assert not list((tmp_path / "without").glob("error_vs_time*"))
        assert (tmp_path / "with" / "error_vs_time.png").is_file()
        costs = json.loads((tmp_path / "with" / "train_log.json").read_text())[-1]
        for part in ("scoring", "writing", "drawing"):
            assert costs[f"curve_{part}_seconds"] > 0
        assert costs["curve_loading_seconds"] >= 0  # for a few tiny photos it may round to 0

    def test_two_hundred_iterations_have_twelve_points(self, colmap_scene, tmp_path, monkeypatch, capfd):
        monkeypatch.setattr("records.curve_recorder.SHORT", 0)
        _train(colmap_scene, tmp_path / "out", "--test_iterations", 90, iterations=200)
        rows = read_curve(tmp_path / "out" / "error_vs_time.csv")
        assert len(rows) >= 12
        assert [row["iteration"] for row in whole_sets(rows)] == [90, 200]
        assert {row["subset"] for row in rows} == {1, None}
        said = re.search(r"^Scored 6 views at \d+ iterations, 1 of each set between --test_iterations, in .*", 
                         capfd.readouterr().out, re.MULTILINE)  # fmt: skip
        log = json.loads((tmp_path / "out" / "train_log.json").read_text())
        assert said[0].startswith(log[-1]["lines"][0])

    @pytest.mark.parametrize("strategy", ["adc", "mcmc", "budget"])
    def test_the_advice_knows_whose_rates_follow_the_length(self, colmap_scene, tmp_path, monkeypatch, strategy):
        given, finish = [], CurveRecorder.finish
        monkeypatch.setattr(CurveRecorder, "finish", lambda *words: (given.append(words[-1]), finish(*words)))
        _train(colmap_scene, tmp_path / "out", "--strategy", strategy, "--max_num_splats", 400, iterations=20)
        assert given == [strategy == "budget"]

    def test_a_row_tells_of_the_model_saved_at_its_iteration(self, colmap_scene, tmp_path, monkeypatch):
        out, measured = tmp_path / "out", Report.measured
        monkeypatch.setattr(Report, "measured", lambda *words: (time.sleep(0.005), measured(*words)))  # after the curve
        _train(colmap_scene, out, "--save_iterations", 30, "--test_iterations", 30, iterations=60)
        row = next(row for row in read_curve(out / "error_vs_time.csv") if row["iteration"] == 30)
        monkeypatch.setattr(sys, "argv", ["render.py", "-m", str(out), "--iteration", "30", "--quiet"])
        render.main()
        psnrs = {"test": [], "train": []}
        for name, values in psnrs.items():
            folder = out / name / "ours_30"
            for file in sorted((folder / "gt").iterdir()):
                with Image.open(file) as gt, Image.open(folder / "renders" / file.name) as ours:
                    values.append(peak_signal_noise_ratio(np.asarray(gt), np.asarray(ours)))
        train_views = [psnrs["train"][index] for index in evenly_spread(range(14), 3)]
        # PNGs are rounded to 8 bits, which at 12 dB changes the error by 1e-6 of itself, in either direction.
        assert row["test_psnr"] == pytest.approx(np.mean(psnrs["test"]), abs=0.01)
        assert row["train_psnr"] == pytest.approx(np.mean(train_views), abs=0.01)
        log = json.loads((out / "train_log.json").read_text())
        assert row["gaussians"] == 300 and row["seconds"] == log[0]["seconds"]
        assert row["peak_memory_mib"] > 0 and row["wall_seconds"] > row["seconds"]

    def test_resume(self, colmap_scene, tmp_path):
        out = tmp_path / "out"
        points = ["--test_iterations", 10, 25, 35, "--checkpoint_iterations", 20]
        whole = _train(colmap_scene, out, *points, iterations=40)
        before = read_curve(out / "error_vs_time.csv")
        log = json.loads((out / "train_log.json").read_text())
        resumed = _train(colmap_scene, out, *points, "--start_checkpoint", out / "chkpnt20.pth", iterations=40)
        assert resumed == whole
        after = read_curve(out / "error_vs_time.csv")
        kept = [row for row in before if row["iteration"] <= 20]
        assert kept and after[: len(kept)] == kept
        assert {25, 35, 40} <= {row["iteration"] for row in after}
        at_20 = next(record for record in log if record["iteration"] == 20)
        for new in after[len(kept) :]:
            assert new["seconds"] > at_20["seconds"] and new["wall_seconds"] > at_20["wall_seconds"]
            old = [row for row in before if row["iteration"] == new["iteration"]]
            for name in ("test_psnr", "train_ssim", "gaussians") if old else ():
                assert new[name] == old[0][name]

    def test_peak_memory_is_that_of_all_parts(self, colmap_scene, tmp_path):
        """The peak of an earlier part that took more, from its last row or its log, whichever is larger."""
        out = tmp_path / "out"
        _train(colmap_scene, out, "--test_iterations", 5, "--checkpoint_iterations", 5, iterations=6)
        log = json.loads((out / "train_log.json").read_text())
        rows = read_curve(out / "error_vs_time.csv")
        own = rows[-1]["peak_memory_mib"]
        assert log[-1]["peak_memory_mib"] >= own > 0
        for of_log, of_row in ((own + 5e4, own), (own, own + 6e4)):
            log[0]["peak_memory_mib"], rows[0]["peak_memory_mib"] = of_log, of_row
            (out / "train_log.json").write_text(json.dumps(log))
            write_curve(out / "error_vs_time.csv", rows)
            _train(colmap_scene, out, "--start_checkpoint", out / "chkpnt5.pth", iterations=6)
            assert read_curve(out / "error_vs_time.csv")[-1]["peak_memory_mib"] == max(of_log, of_row)
        assert json.loads((out / "train_log.json").read_text())[-1]["peak_memory_mib"] < own + 5e4

    def test_interrupted_and_gone_on(self, colmap_scene, tmp_path, monkeypatch):
        out = tmp_path / "out"
        plain, calls = objective.photometric_loss, []

        def interrupted(*args: object) -> tuple:
            calls.append(1)
            if len(calls) == 8:
                os.kill(os.getpid(), signal.SIGINT)
            return plain(*args)

        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(objective, "photometric_loss", interrupted)
            _train(colmap_scene, out, "--test_iterations", 6, 8, iterations=20)
        assert _iterations(out)[-2:] == [6, 8] and not (out / "error_vs_time.png").exists()
        _train(colmap_scene, out, "--start_checkpoint", out / "chkpnt8.pth", iterations=20)
        assert _iterations(out)[-1] == 20 and {6, 8} <= set(_iterations(out))
        assert (out / "error_vs_time.png").exists()

    def test_one_iteration(self, colmap_scene, tmp_path):
        _train(colmap_scene, tmp_path / "out", iterations=1)
        assert _iterations(tmp_path / "out") == [1]

    @pytest.mark.parametrize("options", [["--no_curve"], "no test views"])
    def test_no_curve_leaves_none_of_an_earlier_training(self, colmap_scene, tmp_path, options):
        out = tmp_path / "out"
        out.mkdir()
        for name in ("error_vs_time.csv", "error_vs_time.png"):
            (out / name).write_text("of another model")
        if options == ["--no_curve"]:
            _train(colmap_scene, out, *options, iterations=2)
        else:
            train.main(["-s", str(colmap_scene), "-m", str(out), "--iterations", "2", "--test_iterations", "-1"])
        assert not list(out.glob("error_vs_time*"))

    def test_neither_matplotlib_nor_the_file_can_stop_a_training(self, colmap_scene, tmp_path, monkeypatch, capfd):
        out = tmp_path / "out"
        (out / "error_vs_time.csv").mkdir(parents=True)
        monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
        assert _train(colmap_scene, out, "--test_iterations", 3, 5, iterations=6)
        error = capfd.readouterr().err
        assert (
            len(re.findall(r"warning: cannot write .*error_vs_time.csv .*training continues without its curve", error))
            == 1
        )
        assert "warning: no error_vs_time.png: ModuleNotFoundError" in error

    def test_a_loss_that_is_not_finite_makes_no_point(self, colmap_scene, tmp_path, monkeypatch):
        monkeypatch.setattr(objective, "photometric_loss", lambda image, *_: (image.sum() * torch.nan,) * 2)
        with pytest.raises(UserError, match="nan in iteration 1"):
            _train(colmap_scene, tmp_path / "out", "--test_iterations", 1, iterations=2)
        assert not (tmp_path / "out" / "error_vs_time.csv").exists()


PROCESS = """
import sys, time
time.sleep(0.5)
import torch
import train
from utils.host import process
before = process.peak_memory_mib(torch.device("cpu"))
torch.ones(300 * 2**20, dtype=torch.uint8)
print(process.wall_seconds(), "matplotlib" in sys.modules, process.peak_memory_mib(torch.device("cpu")) - before)
"""


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="this system does not tell when a process started")
def test_what_a_process_has_used():
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", PROCESS], cwd=ROOT, capture_output=True, text=True, check=True)
    elapsed = time.perf_counter() - start
    seconds, drawn, grown = done.stdout.split()
    assert 0.5 < float(seconds) < elapsed + 0.01  # the start is known to a clock tick
    assert drawn == "False"  # training alone does not import matplotlib
    assert 300 - 64 < float(grown) < 300 + 64  # libraries may hold some memory of their own in reserve


def test_a_system_that_tells_nothing(monkeypatch):
    monkeypatch.setattr(process, "Path", lambda _: Path("/nowhere"))
    assert 0 < process.wall_seconds() <= time.perf_counter()
    assert process.peak_memory_mib(torch.device("cpu")) is None


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_memory_of_a_gpu():
    held = torch.ones(2**26, dtype=torch.uint8, device="cuda")
    assert process.peak_memory_mib(held.device) >= 64
