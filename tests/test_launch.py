"""Trainings that torchrun starts: one writer, one voice, one end. Every rank trains the whole model, or a part."""

import csv
import json
import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest
import torch
from launching import ROOT, Launched, command, environment, launch, launch_fault, outputs, words
from waiting import wait_for

import train

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


@pytest.mark.parametrize("fault", ["warning 1 0", "whole-warning 1 0"])
def test_several_ranks_write_the_files_of_one_and_speak_with_one_voice(colmap_scene, tmp_path, fault):
    _train(colmap_scene, tmp_path / "one", "--eval")
    done = launch(tmp_path / "logs", fault, *words(colmap_scene, tmp_path / "out", "--eval"))
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
    assert "rank 1: warning: of one rank alone" in done.stderr[0].splitlines()


def _tensors(path: Path) -> list[torch.Tensor]:
    capture, _ = torch.load(path, weights_only=False)
    return [part for part in capture if torch.is_tensor(part)]


STANDS = "the last checkpoint stands: resume with --start_checkpoint {out}/chkpnt5.pth"


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("kill 0 7", "error: rank 0 ended without a word (killed, or crashed); " + STANDS),
        ("bug 1 7", "error: rank 1: ValueError: no such thing"),
        ("hang 1 7", "error: rank 1 hung: the others waited"),
        (
            "whole-hang 1 27",
            "error: rank 1 hung: the others waited",
        ),  # after the first epoch, in which photos are decoded
        ("whole-kill 0 7", "error: rank 0 ended without a word (killed, or crashed); " + STANDS),
    ],
    ids=lambda value: value.split()[0] if isinstance(value, str) and value[:5] != "error" else "",
)
def test_a_fault_of_one_rank_ends_all_with_one_sentence(colmap_scene, tmp_path, fault, said):
    began = time.monotonic()
    size = 3 if fault == "kill 0 7" else 2
    done = launch_fault(colmap_scene, tmp_path, fault, "--iterations", "40", size=size)
    assert time.monotonic() - began < 90  # 30 seconds on a machine that does nothing else
    assert done.status != 0
    (line,) = done.errors
    assert line.startswith(said.format(out=tmp_path / "out")), line
    assert f"--start_checkpoint {tmp_path}/out/chkpnt5.pth" in line or fault == "bug 1 7"
    text = "".join(done.stderr)
    assert "closed by peer" not in text and ("Traceback" in text) == fault.startswith("bug")
    assert [path.name for path in (tmp_path / "out").glob("chkpnt*.pth")] == ["chkpnt5.pth"]
    assert not list((tmp_path / "out").rglob("*.tmp*"))


def test_no_rank_goes_on_after_one_has_stopped(colmap_scene, tmp_path):
    """Rank 0 has no fault of its own: what it saves is the model after the iteration in which the other stopped."""
    done = launch_fault(colmap_scene, tmp_path, "overflow 1 7")
    (line,) = done.errors
    assert line.startswith("error: xyz of 1 of 300 (131) had no finite step in iteration 7 (view "), line
    assert sorted(path.name for path in (tmp_path / "out").glob("chkpnt*")) == ["chkpnt5.pth", "chkpnt7.pth"]
    _train(colmap_scene, tmp_path / "one", "--no_curve", "--checkpoint_iterations", "7")
    # The parameters; statistics of density control go on until the fault is noticed, as with one process.
    was, now = (_tensors(folder / "chkpnt7.pth")[:6] for folder in (tmp_path / "one", tmp_path / "out"))
    differ = {row for pair in zip(was, now, strict=True) for row in (pair[0] != pair[1]).nonzero()[:, 0].tolist()}
    assert differ <= {131}  # row 3 of the second of two parts, if the ranks have parts


@pytest.mark.parametrize("fault", ["interrupt 1 7", "whole-interrupt 1 7"])
def test_a_signal_to_one_rank_stops_all_after_one_iteration(colmap_scene, tmp_path, fault):
    done = launch_fault(colmap_scene, tmp_path, fault)
    assert done.stdout[0].count("each of 2 GPUs trains the whole model") == fault.count("whole")
    _assert_interrupted(done)
    assert [path.name for path in sorted((tmp_path / "out").glob("chkpnt*.pth"))] == ["chkpnt5.pth", "chkpnt8.pth"]
    records = json.loads((tmp_path / "out" / "train_log.json").read_text())
    assert [record["iteration"] for record in records] == [5, 6, 8]


@pytest.mark.parametrize("stopped", [False, True], ids=["", "after all ranks were stopped"])
def test_a_signal_to_torchrun_saves_one_checkpoint(colmap_scene, tmp_path, stopped):
    """Ranks that were all stopped, as on a laptop that sleeps, go on, although one of them continues first."""
    given = words(colmap_scene, tmp_path / "out", "--no_curve", "--iterations", "100000")
    line = command(tmp_path / "logs", 2, "none 0 0", *given)
    with subprocess.Popen(line, cwd=tmp_path, env=environment(), stdout=-3, stderr=-3) as process:
        try:
            wait_for(lambda: (tmp_path / "out" / "chkpnt5.pth").exists())
            if stopped:
                time.sleep(3)  # until each knows that the others are in a step
                ranks = _stop_and_continue(process.pid)
                time.sleep(3)
                assert all(Path(f"/proc/{rank}").exists() for rank in ranks)
            process.send_signal(signal.SIGINT)
            status = process.wait(60)
        finally:
            process.kill()
    done = outputs(tmp_path / "logs", 2, status)
    _assert_interrupted(done)
    assert len(list((tmp_path / "out").glob("chkpnt*.pth"))) == 2


def _stop_and_continue(process: int) -> list[int]:
    """Stop the children of a process for longer than ranks wait for each other. The last then waits for the first."""
    ranks = [int(rank) for rank in Path(f"/proc/{process}/task/{process}/children").read_text().split()]
    assert len(ranks) == 2
    for rank in ranks:
        os.kill(rank, signal.SIGSTOP)
        time.sleep(0.5)
    time.sleep(4)
    for rank in reversed(ranks):
        os.kill(rank, signal.SIGCONT)
        time.sleep(1.5)
    return ranks


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
    with (other / "splatting" / "training" / "density.py").open("a") as file:
        file.write("# changed\n")
    done = launch_fault(colmap_scene, tmp_path, "code 1 0", OTHER_CODE=str(other))
    said = "error: rank 1 differs from rank 0 in splatting/training/density.py; give all ranks the same files"
    assert done.status != 0 and done.errors == [said]
    assert not (tmp_path / "out").exists()


def test_ranks_keep_the_pace_of_the_first(colmap_scene, tmp_path):
    paced = ("--iterations", "3000", "--eval", "--time_budget", "2", "--target_psnr", "90", "--test_iterations", "-1")
    given = ["-s", str(colmap_scene), "-m", str(tmp_path / "out"), "-r", "2", *paced]
    done = launch(tmp_path / "logs", "none 0 0", *given)
    assert done.status == 0 and done.errors == []
    schedule = json.loads((tmp_path / "out" / "schedule.json").read_text())
    records = json.loads((tmp_path / "out" / "train_log.json").read_text())
    assert schedule["ended"] == records[-1]["iteration"] > 20
