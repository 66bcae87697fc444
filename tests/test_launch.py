"""Trainings that torchrun starts: one writer, one voice, one end."""

import csv
import json
import shutil
import signal
import subprocess
from pathlib import Path

import pytest
import torch
from launching import ROOT, Launched, command, environment, launch, launch_fault, outputs, words
from waiting import wait_for

import train

pytestmark = pytest.mark.slow
SECONDS = ("seconds", "wall_seconds", "peak_memory_mib")


def _files(folder: Path) -> list[str]:
    names = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    return sorted(name for name in names if "tfevents" not in name)


def _train(scene: Path, out: Path, *options: str) -> None:
    train.main(words(scene, out, *options, "--disable_viewer", "--quiet"))


def _assert_interrupted(done: Launched) -> None:
    text = "".join(done.stderr)
    assert done.status != 0 and done.errors == []
    assert text.count("interrupted") == 1 and text.count("with --start_checkpoint") == 1


def test_several_ranks_write_the_files_of_one_and_the_first_speaks(colmap_scene, tmp_path):
    _train(colmap_scene, tmp_path / "one", "--eval")
    done = launch(tmp_path / "logs", "none 0 0", *words(colmap_scene, tmp_path / "out", "--eval"))
    assert done.status == 0
    one, out = tmp_path / "one", tmp_path / "out"
    assert _files(one) == _files(out)
    for name in ("cameras.json", "input.ply", "point_cloud/iteration_12/point_cloud.ply"):
        assert (one / name).read_bytes() == (out / name).read_bytes(), name
    rows = [list(csv.DictReader((folder / "error_vs_time.csv").open())) for folder in (one, out)]
    # The clock decides how many points lie between, and of how many views.
    was, now = ({(row["iteration"], row["subset"]): row for row in points} for points in rows)
    both = was.keys() & now.keys()
    assert rows[0][-1]["iteration"] == rows[1][-1]["iteration"] and (rows[0][-1]["iteration"], "") in both
    for point in both:
        same = [{k: v for k, v in points[point].items() if k not in SECONDS} for points in (was, now)]
        assert same[0] == same[1]
    assert done.stdout[0].count("printed by every rank") == 1 and "Training complete." in done.stdout[0]
    assert done.stdout[1] == done.stderr[1] == ""
    assert "Training progress" in done.stderr[0]
    assert done.stderr[0].count("warning: of every rank") == 1


def _tensors(path: Path) -> list[torch.Tensor]:
    capture, _ = torch.load(path, weights_only=False)
    return [part for part in capture if torch.is_tensor(part)]


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("kill 0 7", ""),
        ("bug 1 7", "ValueError: no such thing"),
        ("memory 1 7", "training ran out of memory ("),
        ("hang 1 7", "error: another rank has ended, or did not answer"),
    ],
    ids=["kill", "bug", "memory", "hang"],
)
def test_a_fault_of_one_rank_ends_all(colmap_scene, tmp_path, fault, said):
    done = launch_fault(colmap_scene, tmp_path, fault, "--iterations", "40")
    assert done.status != 0
    text = "".join(done.stderr)
    assert said.format(out=tmp_path / "out") in text and ("Traceback" in text) == fault.startswith("bug")
    assert [path.name for path in (tmp_path / "out").glob("chkpnt*.pth")] == ["chkpnt5.pth"]
    assert not list((tmp_path / "out").rglob("*.tmp*"))


def test_an_error_of_all_ranks_is_said_once(tmp_path):
    done = launch_fault(tmp_path / "none", tmp_path, "none 0 0")
    (line,) = done.errors
    assert done.status != 0 and line.startswith(f"error: no scene folder {tmp_path}/none")


def test_no_rank_goes_on_after_one_has_stopped(colmap_scene, tmp_path):
    """Rank 0 has no fault of its own: what it saves is the model after the iteration in which the other stopped."""
    done = launch_fault(colmap_scene, tmp_path, "overflow 1 7")
    # On a busy machine the other rank also says it before torchrun ends it.
    (line,) = {line.replace("error: rank 1: ", "error: ") for line in done.errors}
    assert line.startswith("error: a step of iteration 7 (view "), line
    assert sorted(path.name for path in (tmp_path / "out").glob("chkpnt*")) == ["chkpnt5.pth", "chkpnt7.pth"]
    _train(colmap_scene, tmp_path / "one", "--no_curve", "--checkpoint_iterations", "7")
    # The parameters; statistics of density control go on until the fault is noticed, as with one process.
    was, now = (_tensors(folder / "chkpnt7.pth")[:6] for folder in (tmp_path / "one", tmp_path / "out"))
    differ = {row for pair in zip(was, now, strict=True) for row in (pair[0] != pair[1]).nonzero()[:, 0].tolist()}
    assert differ <= {131}  # row 3 of the second of two parts, if the ranks have parts


def test_a_signal_to_one_rank_stops_all_after_one_iteration(colmap_scene, tmp_path):
    done = launch_fault(colmap_scene, tmp_path, "interrupt 1 7")
    _assert_interrupted(done)
    assert [path.name for path in sorted((tmp_path / "out").glob("chkpnt*.pth"))] == ["chkpnt5.pth", "chkpnt8.pth"]
    records = json.loads((tmp_path / "out" / "train_log.json").read_text())
    assert [record["iteration"] for record in records] == [5, 6, 8]


def test_a_signal_to_torchrun_saves_one_checkpoint(colmap_scene, tmp_path):
    given = words(colmap_scene, tmp_path / "out", "--no_curve", "--iterations", "100000")
    line = command(tmp_path / "logs", 2, "none 0 0", *given)
    with subprocess.Popen(line, cwd=tmp_path, env=environment(), stdout=-3, stderr=-3) as process:
        try:
            wait_for(lambda: (tmp_path / "out" / "chkpnt5.pth").exists())
            process.send_signal(signal.SIGINT)
            status = process.wait(60)
        finally:
            process.kill()
    done = outputs(tmp_path / "logs", 2, status)
    _assert_interrupted(done)
    assert len(list((tmp_path / "out").glob("chkpnt*.pth"))) == 2


def test_a_restarted_training_goes_on_from_its_newest_checkpoint(colmap_scene, tmp_path):
    done = launch_fault(colmap_scene, tmp_path, "kill 1 7", restarts=1)
    assert done.status == 0
    assert f"Restarted by torchrun: resuming {tmp_path / 'out' / 'chkpnt5.pth'}" in done.stdout[0]
    _train(colmap_scene, tmp_path / "one", "--no_curve")
    for iteration in (6, 12):
        name = f"point_cloud/iteration_{iteration}/point_cloud.ply"
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "out" / name).read_bytes()


def test_ranks_with_other_code_are_refused(colmap_scene, tmp_path):
    other = tmp_path / "other"
    for room in {path.parent for path in ROOT.glob("*/__init__.py")} | {ROOT / "utils"}:
        shutil.copytree(room, other / room.name)
    shutil.copy(ROOT / "train.py", other)
    with (other / "splatting" / "schedule.py").open("a") as file:
        file.write("# changed\n")
    done = launch_fault(colmap_scene, tmp_path, "code 1 0", OTHER_CODE=str(other))
    said = "error: rank 1 differs from rank 0 in splatting/schedule.py; give all ranks the same files"
    assert done.status != 0 and done.errors == [said]  # of rank 0, for all
    assert not (tmp_path / "out").exists()


def test_ranks_keep_the_pace_of_the_first(colmap_scene, tmp_path):
    paced = ("--iterations", "3000", "--eval", "--time_budget", "5", "--test_iterations", "-1")
    given = ["-s", str(colmap_scene), "-m", str(tmp_path / "out"), "-r", "2", *paced]
    done = launch(tmp_path / "logs", "none 0 0", *given)
    assert done.status == 0 and done.errors == []
    schedule = json.loads((tmp_path / "out" / "schedule.json").read_text())
    records = json.loads((tmp_path / "out" / "train_log.json").read_text())
    assert schedule["ended"] == records[-1]["iteration"] > 20
