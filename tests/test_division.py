"""Ranks that train the whole model each, and divide it later: the bytes of one process, and one end for all."""

import math
import os
import signal
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch
from processes import in_ranks
from step_ways import Immediate, Rerun
from test_sleeping import _sleeps, _trained
from test_sleeping import scene as scene  # a fixture
from trainings import ITERATIONS, OPTIONS, differences

from scene.gaussian_model import GaussianModel
from scene.gaussians.checkpoint import ASLEEP, further, load_checkpoint
from splatting.distributed.ranks import ranks
from splatting.training import division, loop
from splatting.training import run as runs
from splatting.training.iteration import Iteration
from splatting.training.observers import divergence
from splatting.training.steps import captured, step_taker
from utils.system_utils import UserError

NEVER = 1000
CHECKPOINTS = "--checkpoint_iterations", 33, ITERATIONS


def _train(source: Path, out: Path, name: str, *options: object) -> dict:
    """Train, with blocks that sleep, and all wake every 7 iterations."""
    with pytest.MonkeyPatch.context() as patch:
        _sleeps(patch)
        return _trained(source, out, *OPTIONS[name], *options)


@pytest.fixture(scope="module")
def alone(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], dict]:
    folder = tmp_path_factory.mktemp("alone")
    return cache(lambda name: _train(scene, folder / name, name, *CHECKPOINTS))


def _in_rank(source: Path, folder: Path, kinds: list[tuple], act: Callable | None = None) -> list[tuple]:
    """Results, on the first rank, or errors; in which iterations the model was whole.

    kinds: name of OPTIONS, the iteration from which on the model may be divided, further options.
    act: of the second rank before iteration 37, or of each if it is `_diverge`.
    """
    found, prepare = [], runs.Run.prepare
    for number, (name, divided, more) in enumerate(kinds):
        whole: list[int] = []

        def prepared(run: runs.Run, at: Iteration, whole: list[int] = whole) -> None:
            prepare(run, at)
            whole.extend([at.iteration] * run.whole)
            if act and at.iteration == 37 and (act is _diverge or not ranks().first):
                act(run)

        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(division.PAYS, "cpu", math.inf)
            patch.setattr(division.Division, "pays", lambda self, at, first=divided: at.iteration >= first)
            patch.setattr(runs.Run, "prepare", prepared)
            try:
                result = _train(source, folder / str(number), name, *more)
            except (KeyboardInterrupt, UserError, FileNotFoundError) as error:  # only the first rank writes
                result = f"{type(error).__name__}: {error}"
        found.append((result, whole))
    return found


def _check(found: list[list[tuple]], kinds: list[tuple], alone: Callable[[str], dict]) -> None:
    for (name, divided, _), (result, whole), *others in zip(kinds, *found, strict=True):
        assert not differences(result, alone(name)), (name, divided)
        assert all(other[1] == whole for other in others)
        assert divided <= whole[-1] < divided + 7 if divided < NEVER else whole[-1] == ITERATIONS


def test_ranks_that_never_divide_or_do_so_later_have_the_bytes_of_one_process(scene, tmp_path, alone):
    kinds = [("default", NEVER, CHECKPOINTS), ("default", 33, CHECKPOINTS), ("default", 15, ("--plain_step",))]
    kinds += [("exposure", 39, ()), ("sparse", 8, ()), ("budget", 20, ()), ("masks", 20, ()), ("poses", 20, ())]
    _check(in_ranks(2, _in_rank, scene, tmp_path, kinds), kinds, alone)
    start = tmp_path / "0/chkpnt33.pth"
    assert further(load_checkpoint(start)[0], ASLEEP)  # some blocks slept
    again = [("default", 45, ("--start_checkpoint", start))]
    _check(in_ranks(3, _in_rank, scene, tmp_path / "again", again), again, alone)


def _captured(source: Path, folder: Path, kinds: list[tuple]) -> tuple[list[tuple], int]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(captured, "Speculation", Immediate)
        patch.setattr(captured, "Recorder", Rerun)
        patch.setattr(loop, "step_taker", lambda run: (captured.CapturedStep if run.whole else step_taker)(run))
        return _in_rank(source, folder, kinds), Rerun.made[0].launches


def test_steps_are_captured_until_the_model_is_divided(scene, tmp_path, alone):
    kinds = [("default", 45, ()), ("poses", 45, ())]
    found, launches = zip(*in_ranks(2, _captured, scene, tmp_path, kinds), strict=True)
    _check(list(found), kinds, alone)
    assert all(20 < number < 45 for number in launches)  # the first rank captures none that its progress bar looks at


def _interrupt(run: runs.Run) -> None:
    os.kill(os.getpid(), signal.SIGINT)


@torch.no_grad()
def _change(run: runs.Run) -> None:
    run.gaussians.raw("opacity")[7] += 0.001


@torch.no_grad()
def _diverge(run: runs.Run) -> None:
    run.gaussians.optimizer.state_of(run.gaussians.raw("xyz"))["exp_avg"][3] = math.inf


def test_a_signal_to_one_rank_stops_all_where_they_agree(scene, tmp_path, alone):
    for ((end, whole),) in in_ranks(2, _in_rank, scene, tmp_path, [("default", NEVER, ())], _interrupt):
        assert end == "KeyboardInterrupt: " and whole[-1] == 40
    start = "--start_checkpoint", tmp_path / "0/chkpnt40.pth"
    assert not differences(_train(scene, tmp_path / "resumed", "default", *start), alone("default"))


@pytest.mark.parametrize(
    ("act", "said"),
    [
        (_change, "rank 1 differs from rank 0 in opacity; one of their GPUs computes wrongly, so find out which; "),
        (_diverge, "the last good model, after iteration 39, is saved"),
    ],
)
def test_faults_end_all_ranks_with_one_sentence(scene, tmp_path, act, said):
    ((one, _),), ((other, _),) = in_ranks(2, _in_rank, scene, tmp_path, [("default", 40, ())], act)
    assert one == other and said in one
    assert (tmp_path / "0/chkpnt39.pth").exists() == (act is _diverge)


def test_a_rank_that_fails_alone_saves_nothing(tmp_path, monkeypatch):
    group = SimpleNamespace(numbers=lambda *_: torch.tensor([[division.FAULT, 0], [0, 0]]), stands=lambda: "it stands")
    run = SimpleNamespace(whole=True, group=group, first_iteration=0, scene=SimpleNamespace(model_path=tmp_path))
    monkeypatch.setattr(divergence, "save_checkpoint", lambda *_: pytest.fail("saved"))
    watch = SimpleNamespace(_run=run, _ranks=ranks(), _fault=divergence.DivergenceWatch._fault, _gaussians=Mock())
    assert divergence.DivergenceWatch._rescue(watch, 7) == "it stands"


def test_a_rank_that_fails_is_met_where_others_share_seconds():
    waited, failed = [], [[0, 1_500_000], [division.FAULT, 0]]
    group = SimpleNamespace(several=True, numbers=lambda *_: torch.tensor(failed), anyone=waited.append)
    assert division.shared_seconds(group, 9.0) == 1.5 and waited == [False]


def test_a_model_that_is_divided_expects_each_ranks_part(monkeypatch):
    monkeypatch.setattr(runs, "agree_on_model", lambda *_: None)
    run = Mock(sleeping=None, density=SimpleNamespace(most_gaussians=1000))
    run.gaussians.gaussian_count = 9
    runs.Run.divide(run)
    run._expect.assert_called_once_with(1000)


def _run_of(monkeypatch: pytest.MonkeyPatch, changes: dict[str, object]) -> SimpleNamespace:
    """One of two ranks, each with a GPU of 80 GiB."""
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (80 << 30, 80 << 30))
    monkeypatch.setattr(division, "free_memory", lambda place: 80 << 30)
    monkeypatch.setattr(division, "local_size", lambda: 2)
    usual = {"device": "cuda", "images_to_load": 0, "gpu_memory": 0.0, "views": 1, "size": 2, "photos": 9 << 30}
    of = SimpleNamespace(**usual | changes)
    images = SimpleNamespace(planned_bytes=of.photos, keep_on=torch.device(changes.get("keep_on", "cuda")))
    cameras = [SimpleNamespace(image_width=1600, image_height=1000)] * 30
    of.group = SimpleNamespace(size=of.size, several=of.size > 1, first=True, anyone=bool)
    of.scene = SimpleNamespace(images=images, getTrainCameras=lambda: cameras)
    of.schedule = of.opt = of.dataset = of
    of.device, of.gaussians, of.first_iteration = torch.device(of.device), GaussianModel(3), 0
    of.clock = SimpleNamespace(seconds=0.0)
    return of


def test_a_model_begins_whole_where_it_and_its_photos_fit(monkeypatch):
    assert division.begins_whole(_run_of(monkeypatch, {}), 40_000_000)
    assert not division.begins_whole(_run_of(monkeypatch, {}), 43_000_000)  # 44 GB
    others = {"device": "cpu", "size": 1, "views": 2, "gpu_memory": 9.0, "images_to_load": 7, "photos": 11 << 30}
    for change in (others | {"keep_on": "cpu"}).items():  # once for each rank of the host
        assert not division.begins_whole(_run_of(monkeypatch, dict([change])), 1000), change


def test_a_model_is_divided_once_two_intervals_were_slow(monkeypatch):
    run = _run_of(monkeypatch, {})
    chosen, found = division.Division(run), []
    for iteration in range(1, 801):
        run.clock.seconds += 0.5 if iteration in (7, 350) else 0.001 if iteration < 500 else 0.007
        found += [iteration] * (iteration % 50 == 0 and chosen.pays(SimpleNamespace(iteration=iteration)))
    assert found == [750]
    run.group.first = False
    assert not chosen.pays(SimpleNamespace(iteration=850))
    monkeypatch.setattr(GaussianModel, "__len__", lambda self: 43_000_000)
    assert chosen.pays(SimpleNamespace(iteration=850))  # for lack of memory
