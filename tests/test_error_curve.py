"""error_vs_time.csv and .png: the file, the schedule, the scores, the figure; training stays the same with them."""

import json
import math
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData
from skimage.metrics import peak_signal_noise_ratio

import train
from gaussian_renderer.scored_views import mean_scores
from splatting import objective
from splatting.records import curve_recorder
from splatting.records.curve_recorder import CurveDrawer, CurveRecorder
from splatting.records.error_curve import (
    COLUMNS,
    Row,
    best_test,
    continue_curve,
    peak_advice,
    read_curve,
    rows_on,
    whole_sets,
    write_curve,
)
from splatting.records.training_log import TrainingLog
from utils.loss_utils import ssim
from utils.system_utils import UserError

ROOT = Path(__file__).parents[1]
VIEWS = {"test": 2, "train": 2}
HEADER = (
    "iteration,seconds,wall_seconds,gaussians,peak_memory_mib,"
    "test_l1,test_psnr,test_ssim,train_l1,train_psnr,train_ssim,subset\n"
)


@pytest.fixture(autouse=True)
def draws(monkeypatch):
    """Here, trainings draw their curve (see conftest.py)."""
    monkeypatch.setattr("splatting.records.curve_recorder.CurveDrawer", CurveDrawer)


def _row(iteration: int, test: float | None, train: float | None = None, **more: float | None) -> Row:
    row = dict.fromkeys(COLUMNS) | {"iteration": iteration, "seconds": iteration / 10, "wall_seconds": iteration / 9}
    return row | {"test_psnr": test, "train_psnr": train} | more


def _train(scene: Path, out: Path, *more: object, iterations: int) -> str:
    train.main(["-s", str(scene), "-m", str(out), "--eval", "--iterations", str(iterations), "-r", "32",
                "--test_iterations", "-1", *map(str, more)])  # fmt: skip
    return (out / "point_cloud" / f"iteration_{iterations}" / "point_cloud.ply").read_bytes()


def _recorder(
    folder: Path, iterations: int, always: list[int], views: dict, rows: tuple[Row, ...] = (), **more: bool
) -> tuple[CurveRecorder, list]:
    """A recorder of made-up scores, and a list of what it loads and scores. A view that is a number has that PSNR."""
    seen = []
    return CurveRecorder(
        str(folder), list(rows), TrainingLog(folder, 0), iterations, always, views,
        lambda views: seen.append(("load", views)),
        lambda view: seen.append(("scores", view)) or {"psnr": view if isinstance(view, float) else 20.0},
        torch.device("cpu"), **more,
    ), seen  # fmt: skip


def _iterations(out: Path) -> list[int]:
    return [row["iteration"] for row in read_curve(out / "error_vs_time.csv")]


class TestFile:
    def test_header_and_empty_fields(self, tmp_path):
        path = tmp_path / "error_vs_time.csv"
        rows = [_row(3, 20.25, math.inf, gaussians=7), _row(5, math.nan, test_l1=0.125)]
        write_curve(path, rows)
        lines = "3,0.3,0.3333333333333333,7,,,20.25,,,,,", "5,0.5,0.5555555555555556,,,0.125,,,,,,"
        assert path.read_text() == HEADER + "\n".join(lines) + "\n"
        assert read_curve(path) == [_row(3, 20.25, None, gaussians=7), _row(5, None, test_l1=0.125)]

    @pytest.mark.parametrize(
        "content",
        [
            *("", "iteration,seconds\n1,2\n", "\xff\x00"),
            *(f"{HEADER}{line}\n" for line in ("x,0.3,,,,,,,,,,", "3,,,,,,,,,,,", "3,0.3,,,,,nan,,,,,")),
            HEADER + "3,0.3,,,,,,,,,\n",  # a line of an older file
            HEADER + "3,0.3,,,,,,,,,,\n3,0.3,,,,,,,,,,2\n",  # the whole before its part
        ],
    )
    def test_damage(self, tmp_path, capsys, content):
        path = tmp_path / "error_vs_time.csv"
        path.write_text(content, encoding="latin-1")
        with pytest.raises(UserError, match="error_vs_time.csv cannot be read as a curve"):
            read_curve(path)
        assert continue_curve(tmp_path, 5) == []
        assert re.fullmatch(r"warning: .*error_vs_time.csv cannot be read .*\n", capsys.readouterr().err)
        assert not path.exists()

    def test_what_a_run_goes_on_from(self, tmp_path):
        path, figure = tmp_path / "error_vs_time.csv", tmp_path / "error_vs_time.png"
        with pytest.raises(UserError, match="--eval"):
            read_curve(path)
        assert continue_curve(tmp_path, 5) == []
        rows = [_row(2, 10.0), _row(5, 11.0), _row(6, 12.0)]
        write_curve(path, rows)
        figure.write_bytes(b"old")
        assert continue_curve(tmp_path, 5) == rows[:2]
        assert read_curve(path) == rows[:2] and not figure.exists()
        assert continue_curve(tmp_path, 0) == [] and not path.exists()


@pytest.mark.parametrize(
    ("iterations", "views", "points", "sets"),
    [
        (200, 4, 12, 1),
        (600, 8, 12, 2),
        (700, 8, 6, 1),
        (2000, 40, 12, 2),
    ],
)
def test_a_short_training_scores_with_its_end_within_five_percent(tmp_path, iterations, views, points, sets):
    """If need be, points between score no training views; where there are few test views, they score all of these."""
    recorder, seen = _recorder(tmp_path, iterations, [-1], {name: [20.0] * views for name in ("test", "train")})
    for iteration in range(1, iterations + 1):
        if recorder.due(range(iteration, iteration + 1), 0, iteration / 10):
            recorder.add(iteration, iteration / 10, 5)
    assert 0.46 * sum(kind == "scores" for kind, _ in seen) <= 0.05 * iterations
    assert len({row["iteration"] for row in recorder.rows}) == points + 1
    between = [row for row in recorder.rows if row["iteration"] < iterations]
    assert [row["train_psnr"] is None for row in between] == [sets == 1] * points
    assert all(row["subset"] is None for row in between) == (points < 12)


class TestScores:
    def test_against_others(self):
        generator = torch.Generator().manual_seed(0)
        renders = [torch.rand(3, 20, 30, generator=generator) for _ in range(2)]
        targets = [(r + 0.1 * torch.randn(r.shape, generator=generator)).clamp(0, 1) for r in renders]
        targets = [(t * 255).round().to(torch.uint8) for t in targets]
        truths = [t.double().numpy() / 255 for t in targets]
        means = mean_scores(zip(renders, targets, (None, None), strict=True))
        pairs = [(t, r.double().numpy()) for t, r in zip(truths, renders, strict=True)]
        psnrs = [peak_signal_noise_ratio(*pair, data_range=1.0) for pair in pairs]
        l1s = [np.abs(t - r).mean() for t, r in pairs]
        ssims = [ssim(torch.from_numpy(r), torch.from_numpy(t)).item() for t, r in pairs]
        assert list(means) == ["l1", "psnr", "ssim"]
        # float32 sums of 1,800 terms: relative errors far below 1e-5, and 1e-5 of the error is 4e-5 dB.
        assert means["l1"] == pytest.approx(np.mean(l1s), rel=1e-5)
        assert means["psnr"] == pytest.approx(np.mean(psnrs), abs=1e-4)
        assert means["ssim"] == pytest.approx(np.mean(ssims), abs=1e-5)

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

    def test_between_the_same_part_of_each_set_is_scored_and_stays_a_line_where_all_is(self, tmp_path):
        views = {"test": [10.0 + n for n in range(25)], "train": [50.0 + n for n in range(25)]}
        recorder, seen = _recorder(tmp_path, 2000, [500], views)
        for iteration in (250, 500, 1000, 2000):
            recorder.add(iteration, iteration / 10, 5)
        rows = recorder.rows
        assert [(row["iteration"], row["subset"]) for row in rows] == [
            (250, 1), (500, 1), (500, None), (1000, 1), (2000, 1), (2000, None)
        ]  # fmt: skip
        scored = [view for what, view in seen if what == "scores"]
        assert len(scored) == 2 * 52 and scored[:52] == scored[52:]
        assert scored[1] == 40 + scored[0] and scored[2:52] == [*views["test"], *views["train"]]
        assert {(row["test_psnr"], row["train_psnr"]) for row in rows_on(rows, 1)} == {tuple(scored[:2])}
        assert {(row["test_psnr"], row["train_psnr"]) for row in whole_sets(rows)} == {(22.0, 62.0)}
        assert read_curve(tmp_path / "error_vs_time.csv") == rows


class TestPeak:
    # As in scenes with few views, the test views peak while the training views still improve.
    ROWS = (_row(500, 18.0, 18.5), _row(2000, 20.3, 23.0), _row(4000, 20.1, 26.0), _row(7000, 19.6, 29.0))

    def test_a_peak_before_the_end_is_named(self):
        best = "Best test PSNR 20.30 dB at iteration 2000 (0.70 above the end)"
        assert peak_advice(list(self.ROWS), {7000}) == f"{best}. Keep it: --save_iterations 2000"
        assert peak_advice(list(self.ROWS), {2000}) == f"{best}. It is saved: render.py --iteration 2000"
        assert peak_advice(list(self.ROWS), {7000}, steady=False) == best

    def test_no_clear_peak_and_subsets_get_no_advice(self):
        rows = [_row(500, 18.0), _row(1000, 30.0, subset=2), *self.ROWS[1:], _row(7001, 10.0, subset=2)]
        assert peak_advice(rows, {7000}) == peak_advice(list(self.ROWS), {7000})
        assert best_test(rows)["iteration"] == 2000 and best_test([_row(1000, 30.0, subset=2)]) is None
        for rows in (list(self.ROWS[:2]), [_row(5, 20.09), _row(7, 20.0)], [_row(5, 20.0), _row(7, None)]):
            assert peak_advice(rows, ()) is None


class TestDrawer:
    """The process that draws while the finished model is saved."""

    @pytest.fixture
    def folder(self, tmp_path, monkeypatch) -> Path:
        (tmp_path / "Füße").mkdir()
        monkeypatch.chdir(tmp_path)
        write_curve("Füße/error_vs_time.csv", [_row(t, 10.0 + t) for t in (1, 2, 4)])
        return Path("Füße")

    @pytest.mark.slow
    def test_another_process_draws_and_imports_no_torch(self, folder):
        drawer = CurveDrawer(folder, VIEWS)
        drawer.begin()
        drawer.draw()
        drawer.draw()  # again, as where a schedule goes on after an end
        assert drawer.finish() is None
        with Image.open(folder / "error_vs_time.png") as image:
            assert min(image.size) > 400
        code = "import sys; import splatting.records.figures; print('torch' in sys.modules)"
        assert subprocess.check_output([sys.executable, "-c", code], cwd=ROOT, text=True) == "False\n"

    def test_what_goes_wrong_is_told(self, folder, monkeypatch):
        (folder / "error_vs_time.png").mkdir()
        drawer = CurveDrawer(folder, VIEWS)
        drawer.draw()
        assert drawer.finish().startswith(f"UserError: cannot write {folder.resolve() / 'error_vs_time.png'} (")

        started = []
        begin = {"Popen": lambda *a, **k: started.append(subprocess.Popen(*a, **k)) or started[-1]}
        monkeypatch.setattr(curve_recorder, "subprocess", SimpleNamespace(**vars(subprocess) | begin))
        drawer = CurveDrawer(folder, VIEWS)
        drawer.begin()
        started[0].kill()
        drawer.draw()
        assert drawer.finish() == "the process that draws it ended with status -9"


class TestTraining:
    def test_no_bit_of_the_model_changes(self, colmap_scene, tmp_path, capfd):
        options = ["--densify_from_iter", 10, "--densification_interval", 20, "--densify_grad_threshold", 1e-5,
                   "--opacity_reset_interval", 45, "--random_background", "--images_to_load", 3]  # fmt: skip
        with_curve = _train(colmap_scene, tmp_path / "with", *options, "--test_iterations", 9, 30, iterations=80)
        scored = re.search(r"\nTest PSNR measured (\d+) times, [\d.]+ s: .*error_vs_time.png", capfd.readouterr().out)
        assert int(scored[1]) == len(_iterations(tmp_path / "with"))
        without = _train(colmap_scene, tmp_path / "without", *options, "--no_curve", iterations=80)
        assert with_curve == without
        assert len(PlyData.read(tmp_path / "with/point_cloud/iteration_80/point_cloud.ply")["vertex"]) > 300
        assert {9, 30, 80} <= set(_iterations(tmp_path / "with"))
        assert not list((tmp_path / "without").glob("error_vs_time*"))
        assert (tmp_path / "with" / "error_vs_time.png").is_file()
        costs = json.loads((tmp_path / "with" / "train_log.json").read_text())[-1]
        assert min(costs[f"curve_{part}_seconds"] for part in ("scoring", "writing", "drawing")) > 0
        assert costs["curve_loading_seconds"] >= 0  # for a few tiny photos it may round to 0

    def test_an_interrupted_training_keeps_its_points_and_draws_nothing(self, colmap_scene, tmp_path, monkeypatch):
        plain, steps = objective.photometric_loss, iter(range(1, 20))

        def interrupted(*args: object) -> tuple:
            if next(steps) == 8:
                raise KeyboardInterrupt
            return plain(*args)

        monkeypatch.setattr(objective, "photometric_loss", interrupted)
        with pytest.raises(KeyboardInterrupt):
            _train(colmap_scene, tmp_path, "--test_iterations", 6, 8, iterations=20)
        assert _iterations(tmp_path) == [6] and not (tmp_path / "error_vs_time.png").exists()

    def test_neither_the_drawing_nor_the_file_can_stop_a_training(self, colmap_scene, tmp_path, monkeypatch, capfd):
        out = tmp_path / "out"
        (out / "error_vs_time.csv").mkdir(parents=True)
        assert _train(colmap_scene, out, "--test_iterations", 3, 5, iterations=6)
        error = capfd.readouterr().err
        unwritten = r"warning: cannot write .*error_vs_time.csv .*training continues without its curve"
        assert len(re.findall(unwritten, error)) == 1 and "warning: no error_vs_time.png: UserError" in error
        monkeypatch.setattr(sys, "executable", "/nowhere/python")
        _train(colmap_scene, tmp_path / "other", iterations=2)
        assert "warning: no error_vs_time.png: no process can be started" in capfd.readouterr().err
