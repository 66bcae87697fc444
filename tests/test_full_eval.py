"""full_eval.py: its runs, resumes, refusals and reports, with stand-ins for its programs and once with real ones."""

import argparse
import base64
import contextlib
import dataclasses
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from synthetic import folder_state
from waiting import LIMIT, wait_for

import full_eval
from arguments import write_cfg_args
from splatting.evaluation import report as report_module
from splatting.evaluation import results_page, stages
from splatting.evaluation.contact_sheet import GAIN, GAP, HEADER, comparisons, draw_worst_views
from splatting.evaluation.error_curve import COLUMNS
from splatting.evaluation.figures import draw_curves, draw_fronts
from splatting.evaluation.model_folder import SCHEDULE, shorter_ends_there
from splatting.evaluation.results_page import BEGIN, END
from splatting.evaluation.runs import Run
from splatting.evaluation.scenes import DATASETS, SceneEntry
from utils.system_utils import UserError

ROOT = Path(__file__).parents[1]
STAND_INS = Path(__file__).parent / "stand_ins"
MACHINE = {
    "commit": "abc", "cpu": "some CPU", "gpu": None, "instruction_set": "avx2", "packages": {"torch": "2"},
    "python": "3.11", "threads": 2,
}  # fmt: skip


@pytest.fixture(autouse=True)
def _stand_ins(monkeypatch):
    monkeypatch.setattr(stages, "_ROOT", STAND_INS)
    monkeypatch.setattr(full_eval, "machine", lambda: MACHINE)
    monkeypatch.setattr(report_module, "draw_curves", lambda *_: False)  # half a second each; see `figures`
    monkeypatch.setattr(report_module, "draw_fronts", lambda path, *_: not Image.new("RGB", (9, 9)).save(path))


@pytest.fixture
def figures(monkeypatch):
    """Draw the figures of the curves, for tests that need them."""
    monkeypatch.setattr(report_module, "draw_curves", draw_curves)
    monkeypatch.setattr(report_module, "draw_fronts", draw_fronts)


@pytest.fixture
def scenes(tmp_path) -> Path:
    """A folder with two scenes, `attic` (COLMAP) and `brick` (Blender)."""
    folder = tmp_path / "scenes"
    (folder / "attic" / "sparse").mkdir(parents=True)
    (folder / "brick").mkdir()
    (folder / "brick" / "transforms_train.json").touch()
    return folder


def calls(scenes: Path) -> list[list[str]]:
    """The command lines of the stand-ins for train.py and render.py, in order."""
    log = scenes / "calls.txt"
    return [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []


def run(*words: object) -> dict:
    full_eval.main([str(word) for word in words])
    return report_of(Path(words[words.index("--output_path") + 1]))


def report_of(output: Path) -> dict:
    return json.loads((output / "report.json").read_text())


def test_commands_of_a_plain_scene(figures, scenes, tmp_path):
    out = tmp_path / "out"
    report = run("--scenes", scenes / "attic", scenes / "brick", "--output_path", out, "--iterations", 40, "--aa",
                 "--", "-r", 2)  # fmt: skip
    attic, attic_render, brick, _ = calls(scenes)
    shared = ["--eval", "--test_iterations", "-1"]
    switches = ["--antialiasing", "--iterations", "40", "-r", "2"]
    assert attic == ["train", "-s", str(scenes / "attic"), "-m", str(out / "attic"), "--disable_viewer", "--quiet",
                     *shared, *switches]  # fmt: skip
    assert brick[7:] == [*shared, "-w", *switches]
    assert attic_render == ["render", "-m", str(out / "attic"), "-s", str(scenes / "attic"), "--iteration", "40",
                            "--skip_train", "--eval", "--quiet", "--antialiasing"]  # fmt: skip
    first = report["runs"][0]
    load = {name: first["iterations"]["40"].pop(name) for name in ("process_seconds", "cpu_seconds")}
    assert load == {"process_seconds": first["wall_seconds"], "cpu_seconds": first["cpu_seconds"]}
    assert 0 < first["cpu_seconds"] < 30 and "| process (s) | CPU (s) |" in (out / "report.md").read_text()
    assert first["finished"] and first["failure"] is None and first["model"] == "attic"
    assert first["iterations"]["40"] == {
        "PSNR": 23.0, "SSIM": 0.9, "LPIPS": None, "fps": 250.0, "gaussians": 16000, "gaussians_saved": 16000,
        "peak_memory_mib": 340.0, "ply_mb": 36e-6, "render_ms": 4.0, "seconds": 16.0,
        "views": 2,
    }  # fmt: skip
    assert first["views"] == {"test": 2, "train": 7} and first["test_sizes"] == [[120, 80]]
    assert first["worst_views"][0] == {"PSNR": 22.0, "file": "00001.png", "picture": "photo_1.jpg"}
    assert first["machine"] == MACHINE and report["published"] == [] and report["cheapest"] == {}
    assert (out / "timing.txt").read_text().startswith("scenes: 0.0")
    for name in ("attic_curves.png", "attic_worst_views.png"):
        with Image.open(out / "figures" / name) as image:
            assert image.width > 300


def test_data_sets_get_the_options_of_the_paper(scenes, tmp_path):
    mip, tanks = tmp_path / "mip", tmp_path / "tat"
    for name in DATASETS["mipnerf360"]:
        (mip / name).mkdir(parents=True)
    (tanks / "truck").mkdir(parents=True)
    with pytest.raises(SystemExit) as status:
        run("-m360", mip, "-tat", tanks, "--output_path", tmp_path / "out", "--fast", "--use_depth", "--use_expcomp")
    assert status.value.code == 1  # "train" is missing
    trained = {Path(words[2]).name: words[10:] for words in calls(mip) if words[0] == "train"}
    switches = ["-d", "depths2/", *full_eval.EXPOSURE, "--optimizer_type", "sparse_adam"]
    assert trained["garden"] == ["-i", "images_4", *switches] and trained["room"] == ["-i", "images_2", *switches]
    assert [words for words in calls(tanks) if words[0] == "train"][0][10:] == switches
    iterations = [words[6] for words in calls(mip) if words[0] == "render"]
    assert iterations == ["7000", "30000"] * 9

    report = report_of(tmp_path / "out")
    failed = [run for run in report["runs"] if run["failure"]]
    assert [run["scene"] for run in failed] == ["train"]
    assert "no such scene folder" in failed[0]["failure"]["lines"][0]
    garden = [row for row in report["published"] if row["scene"] == "garden" and row["iteration"] == 30000]
    assert [row["table"] for row in garden] == [
        "Kerbl et al. 2023", "official code, re-run by the gsplat authors",
    ]  # fmt: skip
    assert garden[0]["numbers"]["PSNR"] == pytest.approx({"ours": 23.0, "published": 27.41, "difference": -4.41})
    assert "LPIPS" not in garden[0]["numbers"]  # ours is null
    assert garden[0]["other_options"] == switches
    means = {(row["scene"], row["iteration"]) for row in report["published"] if row["scene"].startswith("mean")}
    assert means == {("mean of mipnerf360", 7000), ("mean of mipnerf360", 30000)}  # Tanks and Temples lacks a scene
    groups = [line.split(":")[0] for line in (tmp_path / "out" / "timing.txt").read_text().splitlines()]
    assert groups == ["mipnerf360", "tanksandtemples"]


@pytest.fixture(params=[None, 1.0])
def _seconds(request, monkeypatch):
    """Let stages take their own time, or all the same time, as a render of an unchanged model may."""
    plain = stages.run_child
    if request.param:
        monkeypatch.setattr(
            stages, "run_child", lambda *a, **k: dataclasses.replace(plain(*a, **k), seconds=request.param)
        )


@pytest.mark.usefixtures("_seconds")
def test_a_second_call_does_nothing_again(scenes, tmp_path):
    out = tmp_path / "out"
    command = ("--scenes", scenes / "attic", "--output_path", out, "--iterations", 40)
    first = run(*command)
    done = calls(scenes)
    assert run(*command) == first
    assert calls(scenes) == done
    assert len((out / "attic" / "scored.txt").read_text().splitlines()) == 1

    (out / "attic" / "test" / "ours_40" / "renders" / "00001.png").unlink()
    run(*command)
    assert [words[0] for words in calls(scenes)[len(done) :]] == ["render"]
    (out / "attic" / "results.json").write_text("{}")
    run(*command)
    (out / "attic" / "point_cloud" / "iteration_40" / "point_cloud.ply").unlink()
    run(*command)
    assert [words[0] for words in calls(scenes)[len(done) + 1 :]] == ["train", "render"]
    assert len((out / "attic" / "scored.txt").read_text().splitlines()) == 4


def test_only_the_first_scoring_tries_a_download(scenes, tmp_path):
    """The stand-in scores no LPIPS, as metrics.py without weights."""
    run("--scenes", scenes / "attic", scenes / "brick", "--output_path", tmp_path, "--iterations", 40)
    tried = [json.loads((tmp_path / name / "scored.txt").read_text())[0] for name in ("attic", "brick")]
    assert tried == [None, "0"]


def test_other_options_are_not_mixed_in(scenes, tmp_path):
    out = tmp_path / "out"
    command = ("--scenes", scenes / "attic", "--output_path", out)
    run(*command, "--iterations", 40)
    done = calls(scenes)
    with pytest.raises(UserError, match="attic was trained with other options .*40; asked for .*50"):
        run(*command, "--iterations", 50)
    (out / "attic" / "full_eval.json").write_text("{broken")
    with pytest.raises(UserError, match="attic holds a model that full_eval.py has not trained"):
        run(*command, "--iterations", 40)
    assert calls(scenes) == done

    (found,) = run(*command, "--skip_training")["runs"]
    assert found["finished"] and (found["machine"], found["options"]) == ({}, None)


def test_finished_models_without_any_data_set(scenes, tmp_path):
    """With --skip_training the reference fails; metrics alone need no data set."""
    out = tmp_path / "out"
    (scenes / "attic").rename(scenes / "garden")
    run("--scenes", scenes / "garden", "--output_path", out, "--iterations", 40)
    report = run("--skip_training", "--skip_rendering", "--output_path", out)
    assert [(run["scene"], run["group"], run["finished"]) for run in report["runs"]] == [("garden", "mipnerf360", True)]


def test_a_failed_scene_is_told_and_the_others_go_on(scenes, tmp_path, capsys):
    out = tmp_path / "out"
    (scenes / "attic" / "broken").touch()
    with pytest.raises(SystemExit) as status:
        run("--scenes", scenes / "attic", scenes / "brick", "--output_path", out, "--iterations", 40)
    assert status.value.code == 1
    report = report_of(out)
    attic, brick = report["runs"]
    assert attic["failure"]["stage"] == "train" and attic["failure"]["command"][1].endswith("train.py")
    assert attic["failure"]["lines"] == ["error: <b>the scene</b> is broken; fix it"]  # no progress bar
    assert brick["finished"] and [row["scene"] for row in report["summary"]] == ["brick"]
    assert "    error: <b>the scene</b> is broken; fix it" in (out / "report.md").read_text()
    assert "&lt;b&gt;the scene&lt;/b&gt; is broken" in (out / "report.html").read_text()
    assert "1 of 2 runs failed: attic" in capsys.readouterr().err

    (scenes / "attic" / "broken").unlink()
    before = len(calls(scenes))
    assert run("--scenes", scenes / "attic", scenes / "brick", "--output_path", out, "--iterations", 40)["runs"][0][
        "finished"
    ]
    assert [words[0] for words in calls(scenes)[before:]] == ["train", "render"]  # of attic alone


def _start(scenes: Path, words: list[str]) -> subprocess.Popen:
    """Start full_eval.py in its own process group; return it once it trains attic, which waits for a signal."""
    (scenes / "attic" / "slow").touch()
    program = (
        "import pathlib, sys; from splatting.evaluation import stages;"
        "import full_eval; from utils.system_utils import run_cli;"
        f"stages._ROOT = pathlib.Path({str(STAND_INS)!r}); full_eval.machine = dict;"
        "full_eval._parse_for_training = lambda words: None; run_cli(full_eval.main)"
    )
    process = subprocess.Popen([sys.executable, "-c", program, *words], cwd=ROOT, stderr=subprocess.PIPE, text=True,
                               start_new_session=True)  # fmt: skip
    wait_for(lambda: (scenes / "attic" / "started").exists() or process.poll() is not None)
    return process


def _interrupt(process: subprocess.Popen, sent: signal.Signals, status: int) -> None:
    """Send a signal to the whole group, as from a terminal on Ctrl-C or when it is closed."""
    try:
        os.killpg(process.pid, sent)
        said = process.communicate(timeout=2 * LIMIT)[1]
    finally:
        process.kill()
    assert process.returncode == status, said


def test_a_checkpoint_beyond_the_iterations_is_resumed_where_the_training_decides_its_end(
    scenes, tmp_path, any_options
):
    out = tmp_path / "out"
    words = ["--scenes", str(scenes / "attic"), "--output_path", str(out), "--iterations", "40"]
    words += ["--", "--time_budget", "20"]
    _interrupt(_start(scenes, words), signal.SIGINT, 130)
    assert run(*words)["runs"][0]["final_iteration"] == 43
    assert calls(scenes)[-2][-2:] == ["--start_checkpoint", str(out / "attic" / "chkpnt41.pth")]


@pytest.mark.parametrize(("sent", "status"), [(signal.SIGINT, 130), (signal.SIGHUP, 143)])
def test_a_signal_reaches_the_training_and_the_next_call_resumes_it(scenes, tmp_path, sent, status):
    out = tmp_path / "out"
    words = ["--scenes", str(scenes / "attic"), str(scenes / "brick"), "--output_path", str(out), "--iterations", "40"]
    _interrupt(_start(scenes, words), sent, status)
    report = report_of(out)
    assert [run["finished"] for run in report["runs"]] == [False, False] and not report["runs"][0]["failure"]
    assert "Not finished: attic; brick." in (out / "report.md").read_text()

    report = run(*words)
    assert [run["finished"] for run in report["runs"]] == [True, True]
    resumed = next(words for words in calls(scenes)[1:] if words[0] == "train")
    assert resumed[-2:] == ["--start_checkpoint", str(out / "attic" / "chkpnt5.pth")]


def test_a_second_one_is_refused_while_the_first_or_its_training_lives(scenes, tmp_path):
    out = tmp_path / "out"
    words = ["--scenes", str(scenes / "attic"), "--output_path", str(out), "--iterations", "40"]
    process = _start(scenes, words)
    trainer = int((out / "attic" / "pid").read_text())
    try:
        with pytest.raises(UserError, match=rf"\(process {process.pid}\).* is at work in .*out; wait"):
            run(*words)
        process.kill()
        process.communicate(timeout=2 * LIMIT)
        with pytest.raises(UserError, match="is at work in"):
            run(*words)  # the training has outlived it
    finally:
        process.kill()
        os.kill(trainer, signal.SIGKILL)
    (scenes / "attic" / "slow").unlink()
    reports = []

    def released() -> bool:
        with contextlib.suppress(UserError):  # the system may take a moment to release the lock
            reports.append(run(*words))
        return bool(reports)

    wait_for(released)
    assert reports[0]["runs"][0]["finished"]  # the remains of the first run do not block it


def test_a_checkpoint_of_a_failure_is_not_gone_on_from(scenes, tmp_path, capsys):
    out = tmp_path / "out"
    words = ["--scenes", str(scenes / "attic"), "--output_path", str(out), "--iterations", "40"]
    (scenes / "attic" / "full").touch()
    with pytest.raises(SystemExit):
        run(*words)
    noted = json.loads((out / "attic" / "full_eval.json").read_text())["stages"]["train_failed"]
    assert noted["checkpoint"] == "chkpnt9.pth" and noted["wall_seconds"] > 0
    (scenes / "attic" / "full").unlink()
    assert run(*words)["runs"][0]["finished"]
    assert "--start_checkpoint" not in calls(scenes)[1]
    assert "training from the start (chkpnt9.pth was left by a training that failed after" in capsys.readouterr().out


def test_an_interrupts_checkpoint_stays_the_one_to_go_on_from(scenes, tmp_path):
    """After an interrupt left a checkpoint at 5, a failure leaves a later one at 9 in the same folder."""
    out = tmp_path / "out"
    words = ["--scenes", str(scenes / "attic"), "--output_path", str(out), "--iterations", "40"]
    _interrupt(_start(scenes, words), signal.SIGINT, 130)
    before = json.loads((out / "attic" / "full_eval.json").read_text())["stages"]["train_interrupted"]["wall_seconds"]
    (scenes / "attic" / "full").touch()
    with pytest.raises(SystemExit):
        run(*words)
    (scenes / "attic" / "full").unlink()
    report = run(*words)
    assert calls(scenes)[-2][-2:] == ["--start_checkpoint", str(out / "attic" / "chkpnt5.pth")]
    assert before > 0.5 and report["runs"][0]["wall_seconds"] > before


@pytest.fixture
def any_options(monkeypatch):
    """Let stand-ins have options that train.py does not take (yet)."""
    monkeypatch.setattr(full_eval, "_parse_for_training", lambda words: None)


def test_a_training_that_ends_by_itself(scenes, tmp_path, any_options):
    """The stand-in goes on beyond --iterations until its time is over, with seed 1 longer than with seed 0."""
    out = tmp_path / "out"
    command = ["--scenes", scenes / "attic", "--output_path", out, "--iterations", 40, "--seeds", 0, 1]
    stale = out / "attic" / "seed_0" / "point_cloud" / "iteration_99" / "point_cloud.ply"
    report = run(*command, "--", "--time_budget", 20)
    assert [entry["final_iteration"] for entry in report["runs"]] == [43, 46]
    assert all(entry["finished"] and entry["open_ended"] for entry in report["runs"])
    (row,) = report["summary"]
    assert row["iterations"] == [43, 46] and row["seeds"] == [0, 1] and row["PSNR"]["values"] == [23.0, 23.1]
    assert row["seconds"]["values"] == pytest.approx([17.2, 18.4])  # those of the log at the end
    assert " 43 to 46 |" in (out / "report.md").read_text()
    done = calls(scenes)
    assert run(*command, "--", "--time_budget", 20)["summary"] == [row] and calls(scenes) == done

    # An earlier attempt of the same training came further.
    stale.parent.mkdir()
    stale.write_text("ply\nelement vertex 1\nend_header\n")
    assert run(*command, "--", "--time_budget", 20)["runs"][0]["final_iteration"] == 43 and calls(scenes) == done
    (stale.parents[1] / "iteration_43" / "point_cloud.ply").unlink()
    assert run(*command, "--", "--time_budget", 20)["runs"][0]["final_iteration"] == 43
    assert [words[0] for words in calls(scenes)[len(done) :]] == ["train", "render"]
    assert "ours_99" not in [path.name for path in (out / "attic" / "seed_0" / "test").iterdir()]


@pytest.mark.parametrize(
    ("words", "last"),
    [
        ((), 30_000),
        (("--iterations", "40", "--time_budget", "0.0", "--schedule", ""), 40),
        (("--iterations", "40", "--time_budget", "0.5"), None),
        (("--time_budget=20",), None),
        (("--schedule", "schedule.json"), None),
        (("--target_psnr", "30"), None),
        (("--iterations", "40", "--resolution_schedule", "pyramid"), 40),
        (("--iterations", "many"), None),
    ],
)
def test_the_last_iteration_as_far_as_options_tell_it(tmp_path, words, last):
    assert Run(SceneEntry("attic", "scenes", None), None, None, tmp_path, words, ()).iterations == last


def test_what_a_model_folder_tells_beside_its_scores(scenes, tmp_path):
    """Gaussians left out, the split, what training said: from files of train.py, some of which may be missing."""
    out, model = tmp_path / "out", tmp_path / "out" / "attic"
    words = ["--scenes", scenes / "attic", "--output_path", out, "--iterations", 40]
    (first,) = run(*words)["runs"]
    assert first["lines"] == [] and first["split"] == "the data set's own"  # photo_0 and photo_1 of nine
    left_out = {"antialiasing": False, "left_out": {"gaussians": 17000, "unseen": 1000}}
    (model / "model.json").write_text(json.dumps(left_out))
    names = ["photo_0", "photo_8", *(f"photo_{i}" for i in range(1, 8))]
    (model / "cameras.json").write_text(json.dumps([{"img_name": name} for name in names]))
    records = json.loads((model / "train_log.json").read_text())
    records[-1]["lines"] = ["Curve of 14 points", "Saved 9 of 10 Gaussians"]
    (model / "train_log.json").write_text(json.dumps(records))
    (second,) = run(*words)["runs"]
    values = second["iterations"]["40"]
    assert (values["gaussians"], values["gaussians_saved"]) == (17000, 16000)
    assert second["split"] == "every 8th by name" and second["lines"] == records[-1]["lines"]
    text = (out / "report.md").read_text()
    assert "17,000" in text and "16,000" not in text and "Gaussians are counted as trained" in text
    assert "every 8th by name" in text and "attic: Curve of 14 points. Saved 9 of 10 Gaussians." in text
    left_out["left_out"]["unseen"] = 999  # belongs to another model: it does not add up with the PLY's rows
    (model / "model.json").write_text(json.dumps(left_out))
    (model / "cameras.json").unlink()
    (third,) = run(*words)["runs"]
    assert third["iterations"]["40"]["gaussians"] == 16000 and third["split"] is None
    write_cfg_args(tmp_path, argparse.Namespace())
    assert shorter_ends_there(tmp_path)  # as a schedule of --iterations does not
    (tmp_path / SCHEDULE).touch()
    assert not shorter_ends_there(tmp_path)


def test_seeds_of_different_ground_truth(scenes, tmp_path):
    """A mask alone is another ground truth: a warning, no mean of the scores, blank pixels on the sheet."""
    out = tmp_path / "out"
    words = ["--scenes", scenes / "attic", "--output_path", out, "--iterations", 40, "--seeds", 0, 1]
    assert run(*words)["warnings"] == []
    method = out / "attic" / "seed_1" / "test" / "ours_40"
    (method / "masks").mkdir()
    mask = Image.new("L", (120, 80), 255)
    mask.paste(0, (0, 0, 120, 20))  # the only difference
    mask.save(method / "masks" / "00001.png")
    (out / "attic" / "seed_1" / "results.json").unlink()
    report = run(*words)
    assert len(report["warnings"]) == 1 and "different ground truth" in report["warnings"][0]
    assert report["warnings"][0] in (out / "report.md").read_text()
    (row,) = report["summary"]
    assert not row["one_ground_truth"] and row["PSNR"] == {"mean": None, "std": None, "values": [23.0, 23.1]}
    assert row["seconds"]["mean"] == 16.0
    view = report["runs"][1]
    assert view["worst_views"][0]["file"] == "00001.png"
    assert draw_worst_views(tmp_path / "sheet.png", view, out)
    with Image.open(tmp_path / "sheet.png") as sheet:
        # Compare the middle of each image: above the label, which is masked, and in the lower half, which is not.
        masked, plain = ([sheet.getpixel((GAP + 60 + i * (120 + GAP), HEADER + y)) for i in range(3)] for y in (1, 60))
    assert masked == [(255,) * 3, (255,) * 3, (0,) * 3] and plain == [(90,) * 3, (90,) * 3, (0,) * 3]


@pytest.fixture
def drawn(monkeypatch) -> list[Figure]:
    """The figures that are saved."""
    figures, plain = [], Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (figures.append(self), plain(self, *a, **k)))
    return figures


def _curve(*rows: tuple) -> list[dict]:
    names = ("seconds", "test_psnr", "test_ssim", "train_psnr", "train_ssim", "subset")
    return [dict.fromkeys(COLUMNS) | dict(zip(names, row, strict=False)) for row in rows]


def test_the_legend_leaves_the_pareto_front_free(tmp_path, drawn):
    curves = {
        "base": _curve((0.3, 15.0, 0.7), (2.8, 29.0, 0.945)),
        "fast start": _curve((0.3, 21.0, 0.8), (3.3, 29.5, 0.95)),
    } | {f"set {i}": _curve((0.31, 15.0, 0.7), (2.9, 28.5, 0.94)) for i in range(6)}  # fmt: skip
    runs = [{"apart": False, "config": config, "curve": curve} for config, curve in curves.items()]
    assert draw_curves(tmp_path / "curves.png", "attic", runs)
    fronts = [next(line for line in axes.lines if line.get_label() == "Pareto front") for axes in drawn[0].axes]
    assert fronts[0].get_xydata().tolist() == [[0.3, 21.0], [2.8, 21.0], [2.8, 29.0], [3.3, 29.0], [3.3, 29.5]]
    assert fronts[0].get_markevery() == 2  # corners are not marked
    for axes, front in zip(drawn[0].axes, fronts, strict=True):
        line = front.get_path().transformed(front.get_transform())
        assert not line.intersects_bbox(axes.get_legend().get_window_extent(), filled=False)


def test_points_of_subsets_are_hollow_and_in_no_front(tmp_path, drawn):
    curve = _curve((0.3, 35.0, 0.9, 36.0, 0.9, 2), (1.0, 36.0, 0.95, 37.0, 0.9, 2), (2.0, 20.0, 0.8, 21.0, 0.8, None))
    for runs in (
        [{"config": None, "apart": False, "curve": curve}],
        [{"config": name, "apart": False, "curve": rows} for name, rows in (("a", curve), ("b", curve[:2]))],
    ):
        assert draw_curves(tmp_path / "curves.png", "attic", runs)
        axes = drawn[-1].axes
        assert axes[0].get_ylabel() == "PSNR of the test views (dB)"
        hollow = [line.get_xydata().tolist() for line in axes[0].lines if line.get_fillstyle() == "none"]
        assert [[0.3, 35.0], [1.0, 36.0]] in hollow
        assert ([[0.3, 36.0], [1.0, 37.0]] in hollow) == (len(runs) == 1)  # the training views
        filled = [line.get_xydata().tolist() for line in axes[0].lines if line.get_fillstyle() == "full"]
        assert [[2.0, 20.0]] in filled
    (front,) = (line for line in axes[0].lines if line.get_label() == "Pareto front")
    assert front.get_xydata().tolist() == [[2.0, 20.0]]
    # The gap between training and test views has a panel of its own, without the difference of two subsets.
    assert axes[2].get_ylabel() == "PSNR of the training views above the test views (dB)"
    assert [line.get_xydata().tolist() for line in axes[2].lines] == [[[2.0, 1.0]], []]


def test_seeds_and_option_sets(figures, scenes, tmp_path, capsys, monkeypatch):
    out, configs = tmp_path / "out", tmp_path / "configs.json"
    configs.write_text('{"base": [], "sh1": ["--sh_degree", 1]}')
    report = run("--scenes", scenes / "attic", "--output_path", out, "--iterations", 40, "--seeds", 0, 2, "--configs",
                 configs)  # fmt: skip
    assert [run["model"] for run in report["runs"]] == [
        "attic/base/seed_0", "attic/base/seed_2", "attic/sh1/seed_0", "attic/sh1/seed_2",
    ]  # fmt: skip
    base, small = report["summary"]
    assert base["PSNR"] == {"mean": pytest.approx(23.1), "std": pytest.approx(0.2 / 2**0.5), "values": [23.0, 23.2]}
    assert base["LPIPS"] == {"mean": None, "std": None, "values": [None, None]}
    assert (base["config"], base["seeds"], small["PSNR"]["mean"]) == ("base", [0, 2], pytest.approx(21.1))
    assert base["one_ground_truth"] and report["warnings"] == []

    levels = report["cheapest"]["attic"]
    # Seed 0 of base ends at 23.0 and seed 2 at 23.2: both reach 23.0. sh1 is twice as fast and ends at 21.0.
    assert levels[0]["psnr"] == 23.0 and levels[0]["seconds"]["config"] == "base"
    assert levels[-1]["psnr"] < 21.0 and levels[-1]["seconds"]["config"] == "sh1"
    said = capsys.readouterr().out
    assert "attic: cheapest option set for a given error" in said and "23.10 ± 0.14" in said
    assert (out / "figures" / "attic_sh1_worst_views.png").exists()
    found = report["reached"]["attic"]
    assert found["default"] == "base" and found["sets"]["sh1"]["final"]["mean"] == pytest.approx(21.1)
    assert report["fronts"]["attic"]["beaten"]["seconds"] == {"base": None, "sh1": None}
    text = (out / "report.md").read_text()
    assert "## Seconds to reach a test PSNR" in text and "## Pareto fronts of option sets" in text
    assert "(figures/attic_fronts.png)" in text and (out / "figures" / "attic_fronts.png").stat().st_size > 10_000

    page = tmp_path / "training.md"
    page.write_text(f"before\n\n{BEGIN}\nold\n{END}\n\nafter\n")
    monkeypatch.setattr(sys, "argv", ["results_page", str(out / "report.json"), "--page", str(page)])
    for _ in range(2):  # the second time nothing changes
        results_page.main()
        text = page.read_text()
        assert text.startswith(f"before\n\n{BEGIN}\n\n| scene") and text.endswith(f"\n\n{END}\n\nafter\n")
        assert "23.10 ± 0.14" in text and "- sh1: `--sh_degree 1`" in text and "some CPU" in text
        assert "old" not in text and text.count("| attic") == 2


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("", "no scenes given"),
        ("--scenes SCENES/attic SCENES/attic", "two scenes are named attic"),
        ("--scenes nowhere", "no such scene folder: nowhere"),
        ("--scenes SCENES/attic --iterations 0", "--iterations must be at least 1"),
        ("--scenes SCENES/attic --seeds 1 1", "--seeds must be distinct"),
        ("--scenes SCENES/attic --seeds 1 -- --seed 2", "--seed is given twice"),
        ("--scenes SCENES/attic -- -m elsewhere", "after --: full_eval.py sets -m itself"),
        ("--scenes SCENES/attic -- --model=elsewhere", "full_eval.py sets --model=elsewhere itself"),
        ("--scenes SCENES/attic --configs nowhere.json", "cannot read nowhere.json"),
        ("--scenes SCENES/attic -- --sh_degree 1 --sh_degreee 2", "after --: unrecognized arguments: --sh_degreee 2;"),
        ("--scenes SCENES/attic -- --sh_degree 4", "after --: --sh_degree must be between 0 and 3"),
        ("--scenes SCENES/attic -- -h", "after --: -h trains nothing"),
        ("--scenes SCENES/attic SCENES/brick --output_path SCENES/brick/eval", "attic would lie in the scene folder"),
        ("--scenes SCENES/attic --output_path SCENES", "attic would lie in the scene folder"),
        ("--scenes SCENES/attic --output_path SCENES/attic --skip_training", "would lie in the scene folder"),
        ("--skip_training --skip_rendering", "no scenes given"),
        ("-m360 SCENES/nowhere", "no such folder: .*nowhere; pass the folder that has bicycle, flowers"),
        ("-m360 SCENES", "scenes has none of the scenes of mipnerf360; pass the folder that has bicycle"),
        ("--scenes SCENES/attic --peer other nowhere.csv", "cannot read nowhere.csv"),
        ("--scenes SCENES/attic SCENES/brick --peer other x.csv", "--peer other: name the scene, too"),
    ],
)
def test_refusals(scenes, tmp_path, words, sentence):
    words = words.replace("SCENES", str(scenes)).split()
    before = folder_state(scenes)
    with pytest.raises(UserError, match=sentence):
        full_eval.main(["--output_path", str(tmp_path / "out"), *words])
    assert calls(scenes) == [] and folder_state(scenes) == before and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("{", "is not a table of option sets"),
        ("[]", "names no option sets"),
        ('{"a": [], "a": []}', "it has a twice"),
        ('{"../a": []}', "cannot name a folder"),
        ('{"seed_1": []}', "cannot name a folder"),
        ('{"a": "--sh_degree 1"}', "a must be a list"),
        ('{"a": ["-s", "x"]}', "a: full_eval.py sets -s itself"),
        ('{"a": [], "b": ["--sh_degreee", 1]}', "configs.json, b: unrecognized arguments: --sh_degreee 1;"),
        ('{"a": ["--sh_degree"]}', "a: argument --sh_degree: expected one argument"),
        ('{"a": ["--iterations", "many"]}', "a: argument --iterations: invalid int value"),
        ('{"a": ["--opacity_lr", -1]}', "a: --opacity_lr must be at least 0"),
        ('{"' + "a" * 300 + '": []}', "the name aaaaaaaaaaaaaaaaaaaa... is too long for a folder"),
        ("[" * 100_000, "is not a table of option sets"),
    ],
)
def test_refused_option_sets(scenes, tmp_path, text, sentence):
    configs = tmp_path / "configs.json"
    configs.write_text(text)
    with pytest.raises(UserError, match=sentence):
        run("--scenes", scenes / "attic", "--output_path", tmp_path / "out", "--configs", configs)


def test_damaged_files_do_not_cost_the_report(scenes, tmp_path, capsys):
    out = tmp_path / "out"
    names = ("cloud", "curve", "fine", "picture", "scores")
    for name in names:
        (scenes / name / "sparse").mkdir(parents=True)
    command = ["--scenes", *(scenes / name for name in names), "--output_path", out, "--iterations", 40]
    run(*command)
    (out / "cloud" / "point_cloud" / "iteration_40" / "point_cloud.ply").write_text("ply\n")
    (out / "curve" / "error_vs_time.csv").write_text("x")
    (out / "picture" / "test" / "ours_40" / "renders" / "00001.png").write_bytes(b"x")
    (out / "scores" / "results.json").write_text("{")
    report = run(*command, "--skip_training", "--skip_rendering", "--skip_metrics")
    assert [run["finished"] for run in report["runs"]] == [False, True, True, True, False]
    assert report["runs"][0]["failure"]["stage"] == "report"
    warnings = capsys.readouterr().err
    assert "error_vs_time.csv cannot be read" in warnings and "no pictures of the test views of picture" in warnings
    assert (out / "report.html").exists()


def test_option_sets_of_another_ground_truth_stand_apart(figures, scenes, tmp_path, drawn):
    out, configs = tmp_path / "out", tmp_path / "configs.json"
    configs.write_text('{"base": ["--sh_degree", 1], "best": [], "flat": ["--sh_degree", 0]}')
    command = ("--scenes", scenes / "attic", "--output_path", out, "--iterations", 40, "--configs", configs)
    assert run(*command)["cheapest"]["attic"][0]["seconds"]["config"] == "best"
    Image.new("RGB", (120, 80)).save(out / "attic" / "best" / "test" / "ours_40" / "gt" / "00000.png")
    (out / "attic" / "best" / "results.json").unlink()
    drawn.clear()
    report = run(*command)
    assert [run["apart"] for run in report["runs"]] == [False, True, False]
    assert {name for row in report["cheapest"]["attic"] for name in row["seconds"]["all"]} == {"base", "flat"}
    assert "Left out of rankings and the Pareto front: best." in report["warnings"][0]
    first, second = (out / "report.md").read_text().split("Scored on other ground truth", 1)
    assert " base |" in first and " best |" not in first and " best |" in second
    lines = {line.get_label(): line for line in drawn[0].axes[0].lines}
    assert "best (other ground truth)" in lines
    apart = {tuple(point) for point in lines["best (other ground truth)"].get_xydata()}
    assert not apart & {tuple(point) for point in lines["Pareto front"].get_xydata()}


def test_a_call_that_scores_nothing_says_so_and_keeps_a_good_report(scenes, tmp_path, capsys):
    out = tmp_path / "out"
    nothing = ("--skip_training", "--skip_rendering", "--skip_metrics", "--output_path", out)
    with pytest.raises(SystemExit) as status:
        run("--scenes", scenes / "attic", *nothing)
    assert status.value.code == 1 and "nothing was scored" in capsys.readouterr().err
    assert report_of(out)["summary"] == []
    run("--scenes", scenes / "brick", "--output_path", out, "--iterations", 40)
    good = folder_state(out)
    del good[".full_eval.lock"]
    with pytest.raises(SystemExit) as status:
        run("--scenes", scenes / "attic", *nothing)
    assert status.value.code == 1 and "the report of an earlier call stays" in capsys.readouterr().err
    assert good.items() <= folder_state(out).items()


def test_a_second_call_with_other_scenes_or_seeds_joins_the_report(scenes, tmp_path):
    out = tmp_path / "out"
    (scenes / "cellar" / "sparse").mkdir(parents=True)
    shared = ("--output_path", out, "--iterations", 40)
    first = run("--scenes", scenes / "attic", *shared)
    second = run("--scenes", scenes / "brick", *shared)
    assert [run["scene"] for run in second["runs"]] == ["attic", "brick"] and second["runs"][0] == first["runs"][0]
    assert second["manifest"]["earlier_commands"] == [first["manifest"]["command"]]
    assert run("--scenes", scenes / "attic", *shared)["runs"] == second["runs"]
    text = (out / "report.md").read_text()
    assert text.count("| attic |") == text.count("| brick |") == 2 and (out / "timing.txt").read_text()  # two tables

    run("--scenes", scenes / "cellar", *shared, "--seeds", 1)
    report = run("--scenes", scenes / "cellar", *shared, "--seeds", 2)
    (row,) = [row for row in report["summary"] if row["scene"] == "cellar"]
    assert row["seeds"] == [1, 2] and row["PSNR"]["std"] > 0
    shutil.rmtree(out / "brick")
    assert [run["scene"] for run in run("--scenes", scenes / "attic", *shared)["runs"]] == ["attic", "cellar", "cellar"]


def test_a_second_call_whose_models_would_lie_in_those_of_the_first_is_refused(scenes, tmp_path):
    out = tmp_path / "out"
    configs = tmp_path / "configs.json"
    configs.write_text('{"base": []}')
    shared = ("--output_path", out, "--iterations", 40)
    run("--scenes", scenes / "attic", *shared)
    run("--scenes", scenes / "brick", *shared, "--configs", configs, "--seeds", 1)
    before = folder_state(out)
    for words in (
        ("attic", "--seeds", 1), ("attic", "--configs", configs), ("brick",),
        ("brick", "--configs", configs),
    ):  # fmt: skip
        with pytest.raises(UserError, match="would lie in each other; give the same --seeds and --configs, or none"):
            run("--scenes", scenes / words[0], *shared, *words[1:])
    assert folder_state(out) == before


def test_peers_are_shown_and_stay_in_the_report(figures, scenes, tmp_path):
    out, peer = tmp_path / "out", tmp_path / "other.csv"
    peer.write_text("iteration,seconds,test_psnr,gaussians\n40,2.5,31.25,1234\n")
    shared = ("--scenes", scenes / "attic", "--output_path", out, "--iterations", 40)
    report = run(*shared, "--peer", "other", peer, "--peer", "third", peer)
    assert [(peer["scene"], peer["name"], peer["curve"][0]["test_psnr"]) for peer in report["peers"]] == [
        ("attic", "other", 31.25), ("attic", "third", 31.25),
    ]  # fmt: skip
    for kind in ("md", "html"):
        text = (out / f"report.{kind}").read_text()
        assert "Other programs" in text and "31.25" in text and "1,234" in text
    assert report["cheapest"] == {}
    peer.write_text("seconds,test_psnr\n3,32\n")
    again = run("--scenes", scenes / "attic", scenes / "brick", *shared[2:], "--peer", "attic/other", peer)
    assert [(peer["name"], peer["curve"][-1]["seconds"]) for peer in again["peers"]] == [("other", 3), ("third", 2.5)]


@pytest.mark.parametrize("name", ["<script>alert(1)<", "[x](javascript:alert(1))", "a\nb", "# a", "caf\udce9"])
def test_names_stay_names_in_the_report(figures, scenes, tmp_path, name):
    (scenes / name / "sparse").mkdir(parents=True)
    out = tmp_path / "out"
    report = run("--scenes", scenes / name, "--output_path", out, "--iterations", 40)
    assert report["runs"][0]["finished"]
    for file in ("report.md", "report.html"):
        text = (out / file).read_text(encoding="utf-8")
        assert text.count("<script") == (file == "report.html") and "<script>alert" not in text
    assert "[x](" not in (out / "report.md").read_text(encoding="utf-8")
    tables = [line for line in (out / "report.md").read_text(encoding="utf-8").splitlines() if line.startswith("|")]
    assert len(tables) == 6 and len({line.count("|") for line in tables[:3]}) == 1  # header, rule and row of two tables
    with Image.open(out / "figures" / f"{name}_curves.png") as image:
        assert image.width > 300


def test_each_test_view_has_photo_render_and_error_in_the_page(scenes, tmp_path):
    out = tmp_path / "out"
    run("--scenes", scenes / "attic", "--output_path", out, "--iterations", 40)
    html = (out / "report.html").read_text()
    assert "http:" not in html and "https:" not in html  # needs nothing else
    assert all(part.startswith("data:image/") for part in html.split('src="')[1:])
    (page,) = re.findall(r"<h2>attic</h2>(.*)<h2>", html, re.DOTALL)
    figures = re.findall(r'<figure class="comparison">.*?</figure>', page, re.DOTALL)
    assert len(figures) == 2 and "photo_0.jpg: 24.00 dB" in figures[0] and "photo_1.jpg: 22.00 dB" in figures[1]
    for figure in figures:
        pictures = re.findall(r'src="data:image/jpeg;base64,([^"]+)" alt="(\w+)"', figure)
        assert [alt for _, alt in pictures] == ["photo", "render", "error"]
        images = [Image.open(io.BytesIO(base64.b64decode(text))) for text, _ in pictures]
        pixels = [[image.getpixel(place) for place in ((60, 8), (60, 60))] for image in images]
        wanted = [[(90, 90, 90)] * 2, [(110, 90, 90), (90, 90, 90)], [(20 * GAIN, 0, 0), (0, 0, 0)]]
        assert np.abs(np.subtract(pixels, wanted)).max() <= 6  # of JPEG
        assert figure.count('<input type="range"') == 1
    assert "data:image" not in (out / "report.md").read_text()


def test_the_report_has_a_bounded_number_of_views(scenes, tmp_path, monkeypatch):
    out = tmp_path / "out"
    (attic,) = run("--scenes", scenes / "attic", "--output_path", out, "--iterations", 40)["runs"]
    assert [view["text"][:11] for view in comparisons(attic, out, 1)] == ["photo_0.jpg"]
    monkeypatch.setattr(report_module, "OF_A_REPORT", 2)
    run("--scenes", scenes / "attic", scenes / "brick", "--output_path", out, "--iterations", 40)
    assert (out / "report.html").read_text().count('<figure class="comparison">') == 2


def test_each_model_becomes_a_page_that_the_report_links(scenes, tmp_path):
    out = tmp_path / "out"
    command = ("--scenes", scenes / "attic", "--output_path", out, "--iterations", 40, "--html_models", "--aa")
    command += ("--seeds", 0, 1)
    report = run(*command)
    pages = ["models/attic/seed_0.html", "models/attic/seed_1.html"]
    assert [entry["page"] for entry in report["runs"]] == pages
    made = [words for words in calls(scenes) if words[0] == "export"]
    assert made[0] == ["export", "-m", str(out / "attic/seed_0"), "-s", str(scenes / "attic"), "--iteration", "40",
                       "--to", str(out / pages[0]), "--antialiasing"]  # fmt: skip
    html, markdown = ((out / f"report.{kind}").read_text() for kind in ("html", "md"))
    for page in pages:
        assert f'<a href="{page}">' in html and f"]({page})" in markdown and (out / page).is_file()
    run(*command)
    assert [words for words in calls(scenes) if words[0] == "export"] == made, "a page was made twice"
    (out / pages[0]).unlink()
    assert run(*command[:6], *command[7:])["runs"][0]["page"] is None, "the link of a page that is gone"
    run(*command)
    assert len([words for words in calls(scenes) if words[0] == "export"]) == 3


def test_for_real(colmap_scene, tmp_path):
    """The real train.py, render.py and metrics.py accept their options, and the report has their results."""
    out = tmp_path / "out"
    words = ["--scenes", str(colmap_scene), "--output_path", str(out), "--iterations", "20"]
    # A proxy that refuses connections, so that LPIPS does not download its weights.
    environment = os.environ | {"TORCH_HOME": os.devnull, "https_proxy": "http://127.0.0.1:9"}
    done = subprocess.run([sys.executable, "full_eval.py", *words], cwd=ROOT, env=environment, capture_output=True,
                          text=True, timeout=300)  # fmt: skip
    assert done.returncode == 0, done.stderr
    report = report_of(out)
    (run,) = report["runs"]
    scores = json.loads((out / "colmap_scene" / "results.json").read_text())["ours_20"]
    values = run["iterations"]["20"]
    assert {key: values[key] for key in scores if key in values} == {
        key: scores[key] for key in ("SSIM", "PSNR", "LPIPS")
    }
    assert values["gaussians"] == 300 and values["seconds"] > 0 and values["peak_memory_mib"] > 50
    assert values["render_ms"] > 0 and values["fps"] > 0
    assert run["views"] == {"test": 3, "train": 14} and run["test_sizes"] == [[96, 64]]
    assert run["curve"][-1]["iteration"] == 20 and run["curve"][-1]["test_psnr"] > 5
    assert run["machine"]["packages"]["torch"] and run["machine"]["commit"]
    assert run["worst_views"][0]["picture"].endswith(".png") and "/" in run["worst_views"][0]["picture"]
    assert len(run["ground_truth_sha256"]) == 64
