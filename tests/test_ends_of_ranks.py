"""Parts of a launch on several ranks that need no second process."""

import argparse
import os
import sys
import zipfile
from pathlib import Path

import pytest
from forks import fork
from trainings import narrow_scene

import train
from arguments import ModelParams
from groundwork.host import machine, torchrun
from groundwork.ranks.ranks import Ranks, refuse_differences, using
from scene import Scene
from scene.gaussian_model import GaussianModel
from splatting.agreement import agree_on_options, agree_on_scene
from splatting.folder import newest_checkpoint
from utils.system_utils import UserError, atomic_write, run_cli

ROOT = Path(__file__).resolve().parents[1]


class _Second(Ranks):
    rank, size = 1, 2


@pytest.fixture
def in_torchrun(monkeypatch):
    """The environment of one of four ranks, two on each host."""
    names = {"RANK": "3", "WORLD_SIZE": "4", "LOCAL_RANK": "1", "LOCAL_WORLD_SIZE": "2", "MASTER_ADDR": "a"}
    for name, value in (names | {"MASTER_PORT": "1"}).items():
        monkeypatch.setenv(name, value)
    return monkeypatch


def test_the_environment_of_torchrun_is_whole_or_none(in_torchrun):
    assert (torchrun.rank(), torchrun.size(), torchrun.local_rank(), torchrun.local_size()) == (3, 4, 1, 2)
    in_torchrun.setattr(os, "sched_getaffinity", lambda pid: set(range(8)), raising=False)
    in_torchrun.setattr(machine, "_read_quota", lambda: float("inf"))
    assert machine.cores() == 4
    in_torchrun.delenv("LOCAL_RANK")  # as on a cluster that sets some of these names itself
    assert (torchrun.rank(), torchrun.size(), torchrun.local_size()) == (0, 1, 1)
    assert machine.cores() == 8


def test_a_command_for_one_process_refuses_several(in_torchrun, capsys):
    for rank, said in ((3, ""), (0, "error: render.py runs in one process; start it without torchrun\n")):
        in_torchrun.setenv("RANK", str(rank))
        in_torchrun.setattr(sys, "argv", ["/some/render.py"])
        with pytest.raises(SystemExit) as ended:
            run_cli(lambda: print("ran"))
        assert ended.value.code == 2 and capsys.readouterr() == ("", said)


def test_a_page_is_refused_on_several_ranks(monkeypatch):
    monkeypatch.setattr(train, "agree_on_options", lambda args: None)  # there is no second process to agree with
    with using(_Second()), pytest.raises(UserError, match="--viewer needs a training of one process"):
        train.main(["-s", "scene", "--viewer", "8080"])


def test_only_the_first_rank_writes(tmp_path):
    with using(_Second()):
        with atomic_write(tmp_path / "new" / "a") as path:
            path.write_text("a")
        with atomic_write(tmp_path / "b", every_rank=True) as path:
            path.write_text("b")
    assert [path.name for path in tmp_path.iterdir()] == ["b"]


def test_differences_name_what_and_whose():
    refuse_differences([{"a": "1"}, {"a": "1"}], "remedy")
    with pytest.raises(UserError) as refused:
        refuse_differences([{"a": "1"}, {"a": "1"}, {"a": "2", "b": "3"}], "do so")
    assert str(refused.value) == "rank 2 differs from rank 0 in a (2, not 1), b (3, not nothing); do so"


class _Asked(_Second):
    """The second of two ranks, which was asked for something else."""

    def all_gather_objects(self, value: dict[str, str]) -> list[dict[str, str]]:
        return [{name: "1" if name == "--seed" else found for name, found in value.items()}, value]


def test_ranks_with_other_options_are_refused():
    with using(_Asked()), pytest.raises(UserError) as refused:
        agree_on_options(argparse.Namespace(iterations=7, seed=2))
    said = "rank 1 differs from rank 0 in --seed (2, not 1); start all ranks with the same command"
    assert str(refused.value) == said


def test_ranks_of_which_one_lacks_the_masks_are_refused(tmp_path):
    source, facts = narrow_scene(tmp_path / "scene"), []

    class Pair(_Second):
        def all_gather_objects(self, value: dict) -> list[dict]:
            facts.append(value)
            return facts[-2:]

    def scene(masks: str) -> Scene:
        given = argparse.Namespace(source_path=str(source), model_path=str(tmp_path), masks=masks)
        return Scene(ModelParams(argparse.ArgumentParser()).extract(given), GaussianModel(0))

    with_masks, without = scene("masks"), scene("")
    with using(Pair()):
        agree_on_scene(with_masks, None)
        with pytest.raises(UserError, match="rank 1 differs from rank 0 in the training views; give all"):
            agree_on_scene(without, None)


def test_checkpoints_of_earlier_trainings_do_not_stand(tmp_path):
    for iteration, age in ((5, 0), (40, 0), (300, 1e9)):
        path = tmp_path / f"chkpnt{iteration}.pth"
        zipfile.ZipFile(path, "w").close()
        os.utime(path, (path.stat().st_mtime - age,) * 2)
    (tmp_path / "chkpnt_best.pth").touch()
    assert newest_checkpoint(str(tmp_path)) == str(tmp_path / "chkpnt40.pth")
    assert newest_checkpoint(str(tmp_path), below=40) == str(tmp_path / "chkpnt5.pth")


_LEAVE = """
from pathlib import Path
import torch.distributed as dist
from groundwork.ranks.process_group import SeveralRanks
dist.init_process_group("gloo", store=dist.HashStore(), rank=0, world_size=1)
ranks = SeveralRanks()
ranks.itself = ranks
threads = lambda: [name.read_text() for name in Path("/proc/self/task").glob("*/comm")]
assert ranks.all_gather_host_ints(7).tolist() == [[7]] and any("gloo" in name for name in threads())
ranks.leave()
assert not any("gloo" in name for name in threads())
"""


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="the names of threads are read from /proc")
def test_no_thread_of_a_group_is_left_behind():
    """Such a thread would end with Python, whose lock it may wait for, and abort the process."""
    done = fork(_LEAVE)
    assert done.status == 0, done.stderr
