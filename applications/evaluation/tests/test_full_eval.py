"""full_eval.py: its runs, resumes, refusals and reports, with stand-ins for its programs and once with real ones."""

import argparse
import base64
import dataclasses
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from stand_ins import run, run_as_programs, run_here
from synthetic import folder_state
from waiting import LIMIT, wait_for

import full_eval
from applications.evaluation import report as report_module
from applications.evaluation.child import Finished, Slot, run_child
from applications.evaluation.figures import draw_curves
from applications.evaluation.plan import DATASETS, dataset_scenes, describe_photos
from applications.evaluation.results import shorter_ends_there
from arguments import write_cfg_args
from groundwork.files.json_files import SCHEDULE
from groundwork.host.interrupt import DeferredInterrupt
from splatting.records.renders import GAIN, ComparedViews
from utils import lpips_utils
from utils.system_utils import Terminated, UserError

ROOT = Path(__file__).parents[3]
MACHINE = {
    "commit": "abc", "cpu": "some CPU", "gpu": None, "instruction_set": "avx2", "packages": {"torch": "2"},
    "python": "3.11", "threads": 2,
}  # fmt: skip
OWN = "--disable_viewer --quiet --no_last_checkpoint"
BASE_AND_SH1 = '{"base": [], "sh1": ["--sh_degree", 1]}'


@pytest.fixture(autouse=True)
def _stand_ins(monkeypatch):
    monkeypatch.setattr(full_eval, "facts_from_process", lambda: MACHINE)
    for name in ("draw_curves", "draw_sizes"):
        monkeypatch.setattr(report_module, name, lambda *_: [])  # half a second each; see `figures`


@pytest.fixture
def figures(monkeypatch):
    """Draw the figures of the curves, for tests that need them."""
    monkeypatch.setattr(report_module, "draw_curves", draw_curves)


@dataclasses.dataclass
class Evaluation:
    """Calls of full_eval.py with scenes of one folder and one output folder."""

    scenes: Path
    out: Path

    def words(self, names: str, *more: object) -> list[str]:
        scenes = [str(self.scenes / name) for name in names.split()]
        return ["--scenes", *scenes, "--output_path", str(self.out), "--iterations", "40", *map(str, more)]

    def __call__(self, names: str, *more: object) -> dict:
        full_eval.main(self.words(names, *more), run)
        return self.report

    def fails(self, names: str, *more: object) -> None:
        with pytest.raises(SystemExit) as status:
            self(names, *more)
        assert status.value.code == 1

    @property
    def report(self) -> dict:
        return json.loads(self.text("json"))

    def text(self, kind: str) -> str:
        return (self.out / f"report.{kind}").read_text(encoding="utf-8")

    def record(self, model: str) -> dict:
        return json.loads((self.out / model / "full_eval.json").read_text())["stages"]

    def calls(self, program: str = "") -> list[list[str]]:
        """The command lines of the stand-ins, in order, of one or all of them."""
        log = self.scenes / "calls.txt"
        every = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
        return [words for words in every if words[0].startswith(program)]


@pytest.fixture
def evaluate(tmp_path) -> Evaluation:
    """Evaluation of a folder with the scenes `attic` (COLMAP) and `brick` (Blender)."""
    folder = tmp_path / "scenes"
    (folder / "attic" / "sparse").mkdir(parents=True)
    (folder / "brick").mkdir()
    (folder / "brick" / "transforms_train.json").touch()
    return Evaluation(folder, tmp_path / "out")


def option_sets(folder: Path, text: str = BASE_AND_SH1) -> list:
    (folder / "configs.json").write_text(text)
    return ["--configs", folder / "configs.json"]


def test_commands_of_a_plain_scene(figures, evaluate):
    report = evaluate("attic brick", "--aa", "--", "-r", 2)
    out, scene = str(evaluate.out / "attic"), str(evaluate.scenes / "attic")
    attic, render, brick, _ = map(" ".join, evaluate.calls())
    shared, switches = "--eval --test_iterations -1", "--antialiasing --iterations 40 -r 2"
    assert attic == f"train -s {scene} -m {out} {OWN} {shared} {switches}"
    assert brick.endswith(f" {OWN} {shared} -w {switches}")
    assert render == f"render -m {out} -s {scene} --iteration 40 --skip_train --eval --quiet --antialiasing"
    first = report["runs"][0]
    load = {name: first["iterations"]["40"].pop(name) for name in ("process_seconds", "cpu_seconds")}
    assert load == {"process_seconds": first["wall_seconds"], "cpu_seconds": first["cpu_seconds"]}
    assert 0 < first["cpu_seconds"] < 30 and "| process (s) | CPU (s) |" in evaluate.text("md")
    assert first["finished"] and first["failure"] is None and first["model"] == "attic"
    assert first["iterations"]["40"] == {
        "PSNR": 23.0, "SSIM": 0.9, "LPIPS": None, "DISTS": None, "STLPIPS": None, "fps": 250.0, "gaussians": 16000,
        "gaussians_saved": 16000, "joules": None, "peak_memory_mib": 340.0, "ply_mb": 36e-6, "render_ms": 4.0,
        "seconds": 16.0, "views": 2, "PSNR_given_poses": None, "PSNR_fitted_appearance": None,
    }  # fmt: skip
    assert first["views"] == {"test": 2, "train": 7} and first["test_sizes"] == [[120, 80]]
    assert first["worst_views"][0] == {"PSNR": 22.0, "file": "00001.png", "picture": "photo_1.jpg"}
    assert first["machine"] == MACHINE and report["published"] == []
    assert (evaluate.out / "timing.txt").read_text().startswith("scenes: 0.0")
    for name in ("attic_psnr.png", "attic_ssim.png", "attic_worst_views.png"):
        assert f"(figures/{name})" in evaluate.text("md") and (evaluate.out / "figures" / name).stat().st_size > 5000


def test_data_sets_get_the_options_of_the_paper(evaluate, tmp_path, capsys):
    mip, tanks = tmp_path / "mip", tmp_path / "tat"
    for folder in (*(mip / name / words[1] for name, words in DATASETS["mipnerf360"].items()), tanks / "truck"):
        folder.mkdir(parents=True)
    words = ["-m360", mip, "-tat", tanks, "--output_path", evaluate.out, "--fast", "--use_depth", "--use_expcomp"]
    full_eval.main([str(word) for word in words], run)
    assert f"not found in {tanks}, left out: train\n" in capsys.readouterr().err
    log = [json.loads(line) for root in (mip, tanks) for line in (root / "calls.txt").read_text().splitlines()]
    trained = {Path(words[2]).name: words[11:] for words in log if words[0] == "train"}
    switches = ["-d", "depths2/", *full_eval.EXPOSURE, "--optimizer_type", "sparse_adam"]
    assert trained["garden"] == ["-i", "images_4", *switches] and trained["room"] == ["-i", "images_2", *switches]
    assert trained["truck"] == switches
    assert [words[6] for words in log if words[0] == "render"] == ["7000", "30000"] * 10

    report, text = evaluate.report, evaluate.text("md")
    assert not any(run["failure"] for run in report["runs"])
    garden = [row for row in report["published"] if row["scene"] == "garden" and row["iteration"] == 30000]
    assert [row["table"].partition(" ")[0] for row in garden] == ["Kerbl", "official", "Deng", "3DGS-MCMC,"]
    assert {(row["photos"], garden[2]["hardware"]) for row in garden} == {("images_4", "RTX 4090 GPU")}
    assert "LPIPS" not in garden[0]["numbers"] and garden[0]["other_options"] == switches  # our LPIPS is null
    means = {(row["scene"], row["iteration"]) for row in report["published"] if row["scene"].startswith("mean")}
    assert means == {("mean of mipnerf360", 7000), ("mean of mipnerf360", 30000)}  # Tanks and Temples lacks a scene
    groups = [line.split(":")[0] for line in (evaluate.out / "timing.txt").read_text().splitlines()]
    assert groups == ["mipnerf360", "tanksandtemples"]
    assert "23.00, 27.41, -4.41" in text and "## Beside published numbers" in text and "images_4, images_2" in text
    assert {entry.options for entry in dataset_scenes("mipnerf360", mip, resize=True)} == {("-r", "4"), ("-r", "2")}
    assert describe_photos(["--eval", "-r", "4", "--test_iterations", "-1"]) == "images, resized by -r 4"


def test_a_second_call_does_nothing_again(evaluate):
    first, model = evaluate("attic"), evaluate.out / "attic"
    done = evaluate.calls()
    assert evaluate("attic") == first and evaluate.calls() == done
    (model / "test" / "ours_40" / "renders" / "00001.png").unlink()
    evaluate("attic")
    (model / "results.json").write_text("{}")
    evaluate("attic")
    assert [words[0] for words in evaluate.calls()[len(done) :]] == ["render"]
    (model / "point_cloud" / "iteration_40" / "point_cloud.ply").unlink()
    evaluate("attic")
    assert [words[0] for words in evaluate.calls()[len(done) + 1 :]] == ["train", "render"]
    assert len((model / "scored.txt").read_text().splitlines()) == 4


def test_weights_and_stlpips_are_checked_first_and_scored_where_they_were_not(evaluate, tmp_path, monkeypatch):
    assert evaluate("attic")["runs"][0]["iterations"]["40"]["DISTS"] is None and "DISTS" not in evaluate.text("md")
    done, checked = evaluate.calls(), []
    with pytest.raises(UserError, match=f"{tmp_path} has no file vgg16-397923af.pth, .* download https://.*vgg16"):
        evaluate("brick", "--weights", tmp_path)
    monkeypatch.setattr(lpips_utils, "weights_file", lambda *_: None)
    monkeypatch.setattr(lpips_utils, "import_stlpips", lambda: checked.append(1))
    assert evaluate("attic", "--weights", tmp_path)["summary"][0]["DISTS"]["mean"] == 0.125
    for more in (["--stlpips"], []):
        assert evaluate("attic", *more)["summary"][0]["STLPIPS"]["mean"] == 0.25
    assert evaluate.calls() == done and checked == [1] and " ST-LPIPS |" in evaluate.text("md")
    scorings = (evaluate.out / "attic" / "scored.txt").read_text().splitlines()
    assert [json.loads(line)[-1] for line in scorings[1:]] == [f"--weights={tmp_path}", "--stlpips"]


def test_other_options_are_not_mixed_in(evaluate):
    evaluate("attic")
    done = evaluate.calls()
    with pytest.raises(UserError, match="attic was trained with other options .*40; asked for .*50"):
        evaluate("attic", "--iterations", 50)
    (evaluate.out / "attic" / "full_eval.json").write_text("{broken")
    with pytest.raises(UserError, match="attic holds a model that full_eval.py has not trained"):
        evaluate("attic")
    assert evaluate.calls() == done
    (found,) = evaluate("attic", "--skip_training")["runs"]
    assert found["finished"] and (found["machine"], found["options"]) == ({}, None)


def test_a_failed_scene_is_told_and_the_others_go_on(evaluate, capsys):
    (evaluate.scenes / "attic" / "broken").touch()
    evaluate.fails("attic brick")
    attic, brick = evaluate.report["runs"]
    said = "error: <b>the scene</b> is broken; fix it"
    assert attic["failure"]["stage"] == "train" and attic["failure"]["command"][1].endswith("train.py")
    assert attic["failure"]["lines"] == [said] and f"    {said}" in evaluate.text("md")
    assert brick["finished"] and [row["scene"] for row in evaluate.report["summary"]] == ["brick"]
    assert "&lt;b&gt;the scene&lt;/b&gt; is broken" in evaluate.text("html")
    assert "1 of 2 runs failed: attic" in capsys.readouterr().err
    (evaluate.scenes / "attic" / "broken").unlink()
    before = len(evaluate.calls())
    assert evaluate("attic brick")["runs"][0]["finished"]
    assert [words[0] for words in evaluate.calls()[before:]] == ["train", "render"]  # of attic alone


def test_an_interrupt_beyond_the_iterations_is_resumed(evaluate):
    """The training decides when it ends."""
    (evaluate.scenes / "attic" / "slow").touch()
    given = ("attic brick", "--", "--time_budget", "20")
    with pytest.raises(KeyboardInterrupt):
        evaluate(*given)
    (evaluate.out / "attic" / "chkpnt42.pth").symlink_to("nothing")
    assert [run["finished"] for run in evaluate(*given)["runs"]] == [True, True]
    checkpoint = evaluate.out / "attic" / "chkpnt41.pth"
    assert evaluate.calls("train")[1][-2:] == ["--start_checkpoint", str(checkpoint)]
    assert not checkpoint.exists() and list(evaluate.report["runs"][0]["iterations"]) == ["43"]


def test_a_checkpoint_of_a_failure_is_not_resumed(evaluate, capsys):
    """The checkpoint is at iteration 9."""
    full = evaluate.scenes / "attic" / "full"
    full.touch()
    evaluate.fails("attic")
    noted = evaluate.record("attic")["train_failed"]
    assert noted["checkpoint"] == "chkpnt9.pth" and noted["cpu_seconds"] == 1
    full.unlink()
    assert evaluate("attic")["runs"][0]["finished"]
    assert "--start_checkpoint" not in evaluate.calls("train")[1]
    assert "training from the start (chkpnt9.pth was left by a training that failed after" in capsys.readouterr().out


def test_a_second_one_is_refused_while_the_first_or_its_training_lives(evaluate):
    attic, model = evaluate.scenes / "attic", evaluate.out / "attic"
    (attic / "slow").touch(), model.mkdir(parents=True)
    program = (  # what full_eval.py does of this, without its imports
        "import sys; from pathlib import Path; from groundwork.files.folders import locked; import stand_ins\n"
        "with locked(Path(sys.argv[1]), 'full_eval.py', 'process {process}', '--output_path', inherited=True):\n"
        "    stand_ins.run_as_programs(['', 'train.py', *sys.argv[2:]])"
    )
    path = os.pathsep.join(map(str, (ROOT, ROOT / "tests")))
    command = [sys.executable, "-c", program, str(evaluate.out), "-s", str(attic), "-m", str(model)]
    process = subprocess.Popen(command, env=os.environ | {"PYTHONPATH": path}, start_new_session=True)
    wait_for(lambda: (attic / "started").exists() or process.poll() is not None)
    try:
        for running in (rf"\(process {process.pid}\).* is running in .*out; wait", "is running in"):
            with pytest.raises(UserError, match=running):
                evaluate("attic")
            process.kill()  # which the training outlives
            process.wait()
    finally:
        process.kill()
        os.kill(int((model / "pid").read_text()), signal.SIGKILL)


def test_a_training_that_ends_by_itself(evaluate):
    """The stand-in goes on beyond --iterations until its time is over, with seed 1 longer than with seed 0."""
    given = ("attic", "--seeds", 0, 1, "--", "--time_budget", 20)
    report = evaluate(*given)
    assert [entry["final_iteration"] for entry in report["runs"]] == [43, 46]
    assert all(entry["finished"] and entry["open_ended"] for entry in report["runs"])
    (row,) = report["summary"]
    assert row["seconds"]["values"] == pytest.approx([17.2, 18.4])  # those of the log at the end
    assert " 43 to 46 |" in evaluate.text("md") and "end by themselves" in evaluate.text("md")
    done, seed = evaluate.calls(), evaluate.out / "attic" / "seed_0"
    (seed / "point_cloud" / "iteration_99").mkdir()  # an earlier attempt of the same training came further
    (seed / "point_cloud" / "iteration_99" / "point_cloud.ply").write_text("ply\nelement vertex 1\nend_header\n")
    assert evaluate(*given)["runs"][0]["final_iteration"] == 43 and evaluate.calls() == done
    (seed / "point_cloud" / "iteration_43" / "point_cloud.ply").unlink()
    assert evaluate(*given)["runs"][0]["final_iteration"] == 43
    assert [words[0] for words in evaluate.calls()[len(done) :]] == ["train", "render"]
    assert not (seed / "test" / "ours_99").exists()


def test_what_a_model_folder_tells_beside_its_scores(evaluate, tmp_path):
    """Gaussians left out, the split, what training said: from files of train.py, some of which may be missing."""
    model = evaluate.out / "attic"
    (first,) = evaluate("attic")["runs"]
    assert first["lines"] == [] and first["split"] == "the data set's own"  # photo_0 and photo_1 of nine
    left_out = {"antialiasing": False, "left_out": {"gaussians": 17000, "unseen": 1000}}
    (model / "model.json").write_text(json.dumps(left_out))
    names = ["photo_0", "photo_8", *(f"photo_{i}" for i in range(1, 8))]
    (model / "cameras.json").write_text(json.dumps([{"img_name": name} for name in names]))
    evaluate("brick")
    for name, lines in (
        ("attic", [f"Curve of 14.5 points: {evaluate.out}/attic/curve.png", "warning: of the start"]),
        ("brick", [f"Curve of 9 points: {evaluate.out}/brick/curve.png", "Its photos differ"]),
    ):
        log = evaluate.out / name / "train_log.json"
        log.write_text(
            json.dumps([*json.loads(log.read_text())[:-1], {"iteration": 40, "seconds": 16, "lines": lines}])
        )
    attic, brick = evaluate("attic brick")["runs"]
    values = attic["iterations"]["40"]
    assert (values["gaussians"], values["gaussians_saved"]) == (17000, 16000)
    assert attic["split"] == "every 8th by name" and brick["lines"] == lines
    text = evaluate.text("md")
    assert "17,000" in text and "Gaussians are counted as trained" in text and "every 8th by name" in text
    assert "\nbrick: Its photos differ.\n" in text and "Curve of" not in text and "\nattic: of the start\n" in text
    write_cfg_args(tmp_path, argparse.Namespace())
    assert shorter_ends_there(tmp_path, 1000)  # as a schedule of --iterations does not
    assert not shorter_ends_there(tmp_path, 999)  # whose SH bands are raised sooner
    (tmp_path / SCHEDULE).touch()
    assert not shorter_ends_there(tmp_path, 1000)


def test_seeds_of_different_ground_truth(evaluate):
    """A mask alone is another ground truth: a warning, no mean of the scores."""
    given = ("attic", "--seeds", 0, 1)
    assert evaluate(*given)["warnings"] == []
    model = evaluate.out / "attic" / "seed_1"
    (model / "test" / "ours_40" / "masks").mkdir()
    mask = Image.new("L", (120, 80), 255)
    mask.paste(0, (0, 0, 120, 20))  # the only difference
    mask.save(model / "test" / "ours_40" / "masks" / "00001.png")
    (model / "results.json").unlink()
    report = evaluate(*given)
    (warning,), (row,) = report["warnings"], report["summary"]
    assert "different ground truth" in warning and warning in evaluate.text("md")
    assert not row["one_ground_truth"] and row["PSNR"] == {"mean": None, "std": None, "values": [23.0, 23.1]}
    assert row["seconds"]["mean"] == 16.0 and report["runs"][1]["worst_views"][0]["file"] == "00001.png"


def test_seeds_and_option_sets(evaluate, tmp_path, capsys):
    report = evaluate("attic", "--seeds", 0, 2, *option_sets(tmp_path))
    models = [f"attic/{name}/seed_{seed}" for name in ("base", "sh1") for seed in (0, 2)]
    assert [run["model"] for run in report["runs"]] == models and report["warnings"] == []
    assert [row["PSNR"]["values"] for row in report["summary"]] == [[23.0, 23.2], [21.0, 21.2]]
    assert report["gains"]["attic"]["default"] == "base" and report["gains"]["attic"]["sets"].keys() == {"sh1"}
    said, text = capsys.readouterr().out, evaluate.text("md")
    assert "attic: gain in test PSNR over base" in said and "23.10 ± 0.14" in said
    assert "\nGain over base on the same seeds.\n" in text
    assert "(figures/attic_worst_views.png)" in text


@pytest.mark.parametrize(("words", "sentence"), [
    ("", "no scenes given"),
    ("--skip_training --skip_rendering", "no scenes given"),
    ("--scenes SCENES/attic SCENES/attic", "two scenes are named attic"),
    ("--scenes nowhere", "no such scene folder: nowhere"),
    ("--scenes SCENES", "scenes is not a scene"),
    ("--scenes SCENES/attic --iterations 0", "--iterations must be at least 1"),
    ("--scenes SCENES/attic --seeds 1 1", "--seeds must be distinct"),
    ("--scenes SCENES/attic --seeds 1 -- --seed 2", "--seed is given twice"),
    ("--scenes SCENES/attic -- -m elsewhere", "after --: full_eval.py sets -m itself"),
    ("--scenes SCENES/attic -- --model=elsewhere", "full_eval.py sets --model=elsewhere itself"),
    ("--scenes SCENES/attic --configs nowhere.json", "cannot read nowhere.json"),
    ("--scenes SCENES/attic -- --sh_degreee 2", "after --: there is no option --sh_degreee; did you"),
    ("--scenes SCENES/attic -- -h", "after --: -h trains nothing"),
    ("--scenes SCENES/attic -- --adv", "after --: --advise trains nothing; give --options auto"),
    ("--scenes SCENES/attic -- --viewer", "after --: --viewer waits for its page to be closed"),
    ("--scenes SCENES/attic SCENES/brick --output_path SCENES/brick/eval", "attic would lie in the scene folder"),
    ("--scenes SCENES/attic --output_path SCENES/attic --skip_training", "would lie in the scene folder"),
    ("-m360 SCENES/nowhere", "no such folder: .*nowhere; pass the folder that has bicycle, flowers"),
    ("--scenes SCENES/attic --resize", "--resize works with -m360 only; give -m360, or"),
    ("-m360 SCENES", "scenes has none of the scenes of mipnerf360; pass the folder that has bicycle"),
    ("-m360 SCENES/mip", "mip/room has no folder images_2; give --resize, which makes photos of images smaller"),
    ("--scenes SCENES/attic --peer other nowhere.csv", "cannot read nowhere.csv"),
    ("--scenes SCENES/attic --gpus 1 2", "--gpus: this machine has no GPU 2; it has 2, from 0 on"),
    ("--scenes SCENES/attic --gpus 0", "torch finds none here; leave --gpus out"),
    ("[" * 100_000, "is not a table of option sets"),
    ("[]", "names no option sets"),
    ('{"a": [], "a": []}', "it has a twice"),
    ('{"../a": []}', "cannot name a folder"),
    ('{"seed_1": []}', "cannot name a folder"),
    ('{"a": "--sh_degree 1"}', "a must be a list"),
    ('{"a": ["-s", "x"]}', "a: full_eval.py sets -s itself"),
    ('{"a": [], "b": ["--iterations", "many"]}', "json, b: argument --iterations: takes a whole number in digits"),
    ('{"a": ["--opacity_lr", -1]}', "a: --opacity_lr must be at least 0"),
    ('{"' + "a" * 300 + '": []}', "the name aaaaaaaaaaaaaaaaaaaa... is too long for a folder"),
])  # fmt: skip
def test_refusals(evaluate, tmp_path, monkeypatch, words, sentence):
    """words: of a call, or the file of option sets."""
    monkeypatch.setattr("torch.cuda.device_count", lambda: 0 if "torch finds none" in sentence else 2)
    (evaluate.scenes / "mip/room").mkdir(parents=True)
    if words[:1] in ("[", "{"):
        (tmp_path / "sets.json").write_text(words)
        words = f"--scenes SCENES/attic --configs {tmp_path}/sets.json"
    before = folder_state(evaluate.scenes)
    with pytest.raises(UserError, match=sentence):
        full_eval.main(f"--output_path {evaluate.out} {words.replace('SCENES', str(evaluate.scenes))}".split(), run)
    assert evaluate.calls() == [] and folder_state(evaluate.scenes) == before and not evaluate.out.exists()


def test_a_call_that_scores_nothing_says_so_and_keeps_a_good_report(evaluate, capsys):
    nothing = ("attic", "--skip_training", "--skip_rendering", "--skip_metrics")
    evaluate.fails(*nothing)
    assert "nothing was scored" in capsys.readouterr().err and evaluate.report["summary"] == []
    evaluate("brick")
    good = folder_state(evaluate.out)
    del good[".full_eval.lock"]
    evaluate.fails(*nothing)
    assert "the report of an earlier call stays" in capsys.readouterr().err
    assert good.items() <= folder_state(evaluate.out).items()


def test_a_second_call_with_other_scenes_or_seeds_joins_the_report(evaluate):
    (evaluate.scenes / "cellar" / "sparse").mkdir(parents=True)
    first, second = evaluate("attic"), evaluate("brick")
    assert [run["scene"] for run in second["runs"]] == ["attic", "brick"] and second["runs"][0] == first["runs"][0]
    assert second["manifest"]["earlier_commands"] == [first["manifest"]["command"]]
    assert evaluate("attic")["runs"] == second["runs"]
    rows = [line.split("|")[1].strip() for line in evaluate.text("md").splitlines() if line.startswith("|")]
    assert rows.count("attic") == rows.count("brick") == 3 and rows.count("mean of 2 scenes") == 2  # of three tables
    assert (evaluate.out / "timing.txt").read_text()
    evaluate("cellar", "--seeds", 1)
    report = evaluate("cellar", "--seeds", 2)
    (row,) = [row for row in report["summary"] if row["scene"] == "cellar"]
    assert row["seeds"] == [1, 2] and row["PSNR"]["std"] > 0
    shutil.rmtree(evaluate.out / "brick")
    assert [run["scene"] for run in evaluate("attic")["runs"]] == ["attic", "cellar", "cellar"]


def test_a_second_call_whose_models_would_lie_in_those_of_the_first_is_refused(evaluate, tmp_path):
    sets = option_sets(tmp_path)
    evaluate("attic"), evaluate("brick", *sets, "--seeds", 1)
    before = folder_state(evaluate.out)
    for words in (("attic", "--seeds", 1), ("attic", *sets), ("brick",), ("brick", *sets)):
        with pytest.raises(UserError, match="would be nested; give the same --seeds and --configs, or none"):
            evaluate(*words)
    assert folder_state(evaluate.out) == before


def test_peers_are_shown_and_stay_in_the_report(evaluate, tmp_path):
    peer = tmp_path / "other.csv"
    peer.write_text("iteration,seconds,test_psnr,gaussians\n40,2.5,31.25,1234\n")
    evaluate("attic", "--peer", "other", peer, "--peer", "third", peer)
    for kind in ("md", "html"):
        assert all(part in evaluate.text(kind) for part in ("Other programs", "31.25", "1,234"))
    peer.write_text("seconds,test_psnr\n3,32\n")
    again = evaluate("attic brick", "--peer", "attic/other", peer)
    assert [(peer["name"], peer["curve"][-1]["seconds"]) for peer in again["peers"]] == [("other", 3), ("third", 2.5)]


def test_names_stay_names_in_the_report(figures, evaluate):
    name = "<script>alert(1)<\n# a[x](javascript:alert(1)) caf\udce9"
    (evaluate.scenes / name / "sparse").mkdir(parents=True)
    words = ["--scenes", str(evaluate.scenes / name), "--output_path", str(evaluate.out), "--iterations", "40"]
    full_eval.main(words, run)
    assert evaluate.report["runs"][0]["finished"]
    text = evaluate.text("md")
    assert [evaluate.text(kind).count("<script") for kind in ("md", "html")] == [0, 1]
    assert "<script>alert" not in evaluate.text("html") and "[x](" not in text
    assert "caf\\udce9" in evaluate.text("csv") and "caf\\textbackslash{}udce9" in evaluate.text("tex")
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert len(rows) == 9 and len({line.count("|") for line in rows[:3]}) == 1  # header, rule and row of three tables
    assert not any(line.startswith("# a") for line in text.splitlines())
    assert (evaluate.out / "figures" / f"{name}_psnr.png").stat().st_size > 5000


def test_each_test_view_has_photo_render_and_error_in_the_page(evaluate, monkeypatch):
    (attic,) = evaluate("attic")["runs"]
    html = evaluate.text("html").replace(lpips_utils._find_url("vgg"), "the address of LPIPS's weights", 1)
    assert "http:" not in html and "https:" not in html  # needs nothing else
    assert "the address of LPIPS's weights into a folder, and repeat the command with --weights FOLDER" in html
    captions = re.findall("<figcaption>(.*?)</figcaption>", html)
    assert len(captions) == html.count('<div class="scroll">') - 1 and all(captions)  # but of the list of views
    assert all(part.startswith("data:image/") for part in html.split('src="')[1:])
    (page,) = re.findall(r"<h2>attic</h2>(.*)<h2>", html, re.DOTALL)
    shown = re.findall(r'<figure class="comparison">.*?</figure>', page, re.DOTALL)
    assert len(shown) == 2 and "<details" in page.split('<figure class="comp')[0]  # on a click
    for figure, name, psnr in zip(shown, ("photo_1.jpg", "photo_0.jpg"), (22, 24), strict=True):
        assert name in figure and f"render: {psnr}.00 dB" in figure and figure.count('<input type="range"') == 1
        found = dict(re.findall(r'src="data:image/jpeg;base64,([^"]+)" alt="(\w+)"', figure))
        assert [*found.values()] == ["photo", "render", "error"]
        images = [Image.open(io.BytesIO(base64.b64decode(text))) for text in found]
        pixels = [[image.getpixel(place) for place in ((60, 8), (60, 60))] for image in images]
        expected = [[(90, 90, 90)] * 2, [(110, 90, 90), (90, 90, 90)], [(20 * GAIN, 0, 0), (0, 0, 0)]]
        assert np.abs(np.subtract(pixels, expected)).max() <= 6  # of JPEG
    assert [view["name"] for view in ComparedViews([attic], evaluate.out).shown(1)] == ["photo_1.jpg"]
    monkeypatch.setattr(report_module, "OF_A_REPORT", 2)  # the number of views is bounded
    evaluate("attic brick")
    assert evaluate.text("html").count('<figure class="comparison">') == 2


def test_each_model_becomes_a_page_that_the_report_links(evaluate):
    given = ("attic", "--aa", "--seeds", 0, 1)
    report = evaluate(*given, "--html_models")
    pages = ["models/attic/seed_0.html", "models/attic/seed_1.html"]
    assert [entry["page"] for entry in report["runs"]] == pages
    made = evaluate.calls("export")
    assert made[0] == ["export", "-m", str(evaluate.out / "attic/seed_0"), "-s", str(evaluate.scenes / "attic"),
                       "--iteration", "40", "--to", str(evaluate.out / pages[0]), "--raw",
                       "--antialiasing"]  # fmt: skip
    for page in pages:
        assert f'<a href="{page}">' in evaluate.text("html") and f"]({page})" in evaluate.text("md")
        assert (evaluate.out / page).is_file()
    evaluate(*given, "--html_models")
    assert evaluate.calls("export") == made, "a page was made twice"


@pytest.mark.slow
def test_for_real(colmap_scene, tmp_path, monkeypatch):
    """The real train.py, render.py and metrics.py accept their options, and the report has their results."""
    out = tmp_path / "out"
    # A proxy that refuses connections, so that LPIPS does not download its weights.
    monkeypatch.setenv("TORCH_HOME", os.devnull)
    monkeypatch.setenv("https_proxy", "http://127.0.0.1:9")
    full_eval.main(["--scenes", str(colmap_scene), "--output_path", str(out), "--iterations", "20"], run_here)
    (run,) = json.loads((out / "report.json").read_text())["runs"]
    scores = json.loads((out / "colmap_scene" / "results.json").read_text())["ours_20"]
    values = run["iterations"]["20"]
    assert all(values[key] == scores[key] for key in ("SSIM", "PSNR", "LPIPS"))
    assert values["gaussians"] == 300 and min(values[name] for name in ("seconds", "peak_memory_mib", "fps")) > 0
    assert run["views"] == {"test": 3, "train": 14} and run["test_sizes"] == [[96, 64]]
    assert run["curve"][-1]["iteration"] == 20 and run["curve"][-1]["test_psnr"] > 5
    assert run["machine"]["packages"]["torch"] and run["machine"]["commit"]


@pytest.fixture
def two_gpus(monkeypatch):
    monkeypatch.setattr("torch.cuda.device_count", lambda: 3)


def test_runs_are_shared_among_gpus(evaluate, two_gpus, capsys, monkeypatch):
    """Four runs on two GPUs, those of the visible ones with these numbers, one on each at a time; two fail."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "5,7,9")
    (evaluate.scenes / "attic" / "broken").touch()
    both, busy, given = threading.Barrier(2), [], ("attic brick", "--seeds", 0, 1)

    def start(command: list[str], say: str, slot: Slot, **environment: str) -> Finished:
        assert slot.gpu in {"5", "9"} - {*busy}
        busy.append(slot.gpu)
        if "attic" in " ".join(command):  # the first two, whose trainings fail together
            both.wait(LIMIT)
        done = run(command, say, slot, **environment)
        busy.remove(slot.gpu)
        return done

    with pytest.raises(SystemExit):
        full_eval.main(evaluate.words(*given, "--gpus", 0, 2), start)
    found = [(run["scene"], run["finished"], bool(run["failure"])) for run in evaluate.report["runs"]]
    assert found == [("attic", False, True)] * 2 + [("brick", True, False)] * 2
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("[")]
    form = r"\[[1-4]/4\] (attic|brick), seed [01]: (on GPU [59]|finished in 0 s|FAILED \(train\): error: .*; fix it)"
    assert len(lines) == 8 and all(re.fullmatch(form, line) for line in lines)
    (evaluate.scenes / "attic" / "broken").unlink()
    before = len(evaluate.calls("train"))
    assert all(run["finished"] for run in evaluate(*given, "--gpus", 1)["runs"])
    assert len(evaluate.calls("train")) == before + 2


def _signal_once(started: list[Path], sent: signal.Signals = signal.SIGINT, times: int = 1) -> None:
    """Send this process a signal once all these files are there, and perhaps again."""

    def send() -> None:
        wait_for(lambda: all(path.exists() for path in started))
        for _ in range(times):
            os.kill(os.getpid(), sent)
            time.sleep(0.5)

    threading.Thread(target=send).start()


@pytest.mark.parametrize(("gpus", "sent", "at_work"), [
    ((), signal.SIGHUP, 1), (("--gpus", 0, 1), signal.SIGINT, 2),
])  # fmt: skip
def test_a_signal_reaches_all_trainings_and_the_next_call_resumes_them(evaluate, two_gpus, gpus, sent, at_work):
    names = ("attic", "brick", "cellar")
    (evaluate.scenes / "cellar" / "sparse").mkdir(parents=True)
    for name in names:
        (evaluate.scenes / name / "slow").touch()
    _signal_once([evaluate.scenes / name / "started" for name in names[:at_work]], sent)
    with pytest.raises(KeyboardInterrupt if sent == signal.SIGINT else Terminated):
        full_eval.main(evaluate.words(" ".join(names), *gpus), run_as_programs)
    stopped = [evaluate.record(name)["train_interrupted"]["checkpoint"] for name in names[:at_work]]
    assert stopped == ["chkpnt5.pth"] * at_work and not (evaluate.out / names[at_work]).exists()
    runs = evaluate.report["runs"]
    assert not any(run["finished"] or run["failure"] for run in runs)
    assert "Not finished: attic; brick; cellar." in evaluate.text("md") and "Nothing was scored." in evaluate.text("md")
    for name in names[at_work:]:
        (evaluate.scenes / name / "slow").unlink()
    assert all(run["finished"] for run in evaluate(" ".join(names), *gpus)["runs"])
    assert sum("--start_checkpoint" in words for words in evaluate.calls("train")) == at_work
    assert not (evaluate.out / "attic" / "chkpnt5.pth").exists()


def test_a_child_has_its_gpu_its_own_seconds_and_its_own_session(capsys):
    """Its last lines are kept, without progress bars, and shown where it is the only one."""
    code = r"import os, sys; sys.stderr.write(' 50%|##  | 5/10\r\n' + os.environ['CUDA_VISIBLE_DEVICES']);"
    code += "assert os.getsid(0) == os.getpid()"  # else a terminal's Ctrl-C would reach it twice
    for slot, gpu, shown in ((Slot("7", DeferredInterrupt()), "7", ""), (None, "4", " 50%|##  | 5/10\r\n4")):
        done = run_child([sys.executable, "-c", code], "", slot, **({} if slot else {"CUDA_VISIBLE_DEVICES": gpu}))
        assert (done.status, done.lines, capsys.readouterr().err) == (0, [gpu], shown)
        assert 0 < done.cpu_seconds < 30


def test_views_without_a_psnr_are_on_no_sheet(tmp_path):
    """Equal images have none, and other option sets may have none of other views."""
    (tmp_path / "model").mkdir()
    scores = {"results": {"SSIM": 0.5, "PSNR": 20.0}, "per_view": {"PSNR": dict.fromkeys(("00000.png", "00001.png"))}}
    for name, found in scores.items():
        (tmp_path / "model" / f"{name}.json").write_text(json.dumps({"ours_30": found}))
    views = ComparedViews([{"config": None, "model": "model", "final_iteration": 30}], tmp_path)
    with pytest.raises(UserError, match="no view has a PSNR"):
        views.draw_worst(tmp_path / "sheet.png")
    assert views.shown(3) == []
