"""Blocks of Gaussians that sleep: what they miss, and that no view shows them.

tests/test_training_bytes.py has the bytes of trainings in which they do.
"""

import math
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from diff_gaussian_rasterization.backend import OPERATORS
from diff_gaussian_rasterization.lens import Lens
from diff_gaussian_rasterization.optim import adam_
from diff_gaussian_rasterization.scene import Scene
from gaussians import needs_fused_step
from processes import in_ranks
from rasterizer_tools import BOTH_AND_GPU, CPU_AND_GPU
from step_ways import Immediate, take_as  # noqa: F401  (a fixture)
from trainings import (
    ITERATIONS,
    OPTIONS,
    before_steps,
    differences,
    narrow_scene,
    plain_training,
    shared_scene,
    sleep,
    trained,
    whole_result,
    with_clusters,
)

import train
from groundwork.ranks.ranks import ranks
from scene import sleeping
from scene.gaussian_model import GaussianModel
from scene.gaussians.checkpoint import extra_state, load_checkpoint, save_checkpoint
from scene.readers.point_cloud import write_point_cloud
from scene.saved_model import read_model
from scene.sleeping import BLOCK, REST
from splatting import run as runs
from splatting.faster import captured
from splatting.iteration import Iteration
from splatting.log import ProgressBar
from splatting.objective import Objective
from utils.system_utils import UserError

BETAS, EPS = (0.9, 0.999), 1e-15
MOST_RATIO = 0.1 / math.sqrt(0.001 * (1 - 0.81 / 0.999))  # of |m| / sqrt(v) (csrc/math/sleep.h)
SCENES, STEPS = 6, (5, 60)  # of random blocks; 1000, or 1 and (7000, 7001), to measure the rounding
VIEWS = 12  # random ones of each lens; 1000 for a thorough test


class Blocks:
    """Raw Gaussians with Adam's state, whose blocks may sleep."""

    def __init__(self, values: list[torch.Tensor], step: int = 0) -> None:
        self.values = values  # in the order of gs::Stepped
        means = values[0]
        count = -(-len(means) // BLOCK)
        self.averages = [torch.zeros_like(value) for value in values * 2]
        self.steps = [torch.tensor(float(step)) for _ in values]
        self.awake = torch.ones(count, dtype=torch.uint8, device=means.device)
        self.taken = torch.full((count,), step, dtype=torch.int32, device=means.device)
        self.terms = torch.zeros(128, 8, dtype=means.dtype, device=means.device)

    def scene(self, camera: tuple) -> Scene:
        means, opacities, scales, rotations, sh_dc, sh_rest = self.values
        return Scene(means, opacities, scales, rotations, None, None, sh_dc, sh_rest, *camera)

    def wake(self, camera: tuple, every: bool, rate: float) -> None:
        sleep, constants = [self.awake, self.taken, self.terms], [*BETAS, EPS, 0.0, 0.0]
        six = range(6)
        lists = self.averages, self.steps, [], [*six], [rate for _ in six], constants, [-1 for _ in six]
        OPERATORS.wake_(*self.scene(camera).lists, sleep, every, *lists)

    def step(self, gradients: list[torch.Tensor], rate: float) -> None:
        adam_(
            self.values, gradients, self.averages[:6], self.averages[6:], self.steps, [rate] * 6, *BETAS, EPS, [-1] * 6
        )


def _rows(count: int, generator: torch.Generator, place: dict) -> list[torch.Tensor]:
    shapes = (3,), (1,), (3,), (4,), (1, 3), (15, 3)
    return [torch.randn(count, *shape, generator=generator, dtype=torch.float64).to(**place) for shape in shapes]


def _camera(view: torch.Tensor, place: dict, lens: Lens | None = None, rays: bool = False) -> tuple:
    """A camera whose matrix world to view is (4, 4); the fields of Scene behind the Gaussians."""
    width, height = 96, 64
    near, tan_x, tan_y = 0.01, 0.7, 0.7 * height / width
    full = torch.zeros(4, 4, dtype=torch.float64)
    full[0, 0], full[1, 1], full[3, 2], full[2, 2], full[2, 3] = 1 / tan_x, 1 / tan_y, 1.0, 1.0, -near
    center = torch.linalg.inv(view)[:3, 3]
    matrices = view.T, (full @ view).T, center
    numbers = lens.numbers(width, height) if lens else ()
    moved = (m.contiguous().to(**place) for m in matrices)
    return *moved, (tan_x, tan_y, 1.0, *numbers), (height, width, 3, False, True, *[rays] * rays)


def _away(place: dict) -> tuple:
    view = torch.eye(4, dtype=torch.float64)
    view[2, 3] = -1e4  # all lie behind it
    return _camera(view, place)


@BOTH_AND_GPU
@pytest.mark.parametrize("missed", [1, 7, 99])
def test_missed_steps_are_those_without_a_gradient(device, dtype, missed):
    place, generator = {"device": device, "dtype": dtype}, torch.Generator().manual_seed(missed)
    slept = Blocks(_rows(300, generator, place))
    for _ in range(5):
        slept.step(_rows(300, generator, place), 0.01)
    slept.taken.fill_(5)
    dense = Blocks([value.clone() for value in slept.values])
    dense.averages, dense.steps = [x.clone() for x in slept.averages], [x.clone() for x in slept.steps]
    before = [value.clone() for value in slept.values]
    for number in range(missed):
        rate = 0.01 * (1 + 0.5 * math.sin(number))  # as a schedule's, or that of a clock
        slept.wake(_away(place), False, rate)
        for step in slept.steps:
            step += 1
        dense.step([torch.zeros_like(value) for value in dense.values], rate)
    assert not slept.awake.any() and (slept.taken == 5).all()
    assert all(map(torch.equal, slept.values, before))
    slept.wake(_away(place), True, 0.01)
    assert (slept.taken == 5 + missed).all()
    most = 1e-12 if dtype == torch.float64 else 2e-6
    for value, other, old in zip(slept.values, dense.values, before, strict=True):
        assert (value - other).abs().max() <= most * (1 + (other - old).abs().max())
    for one, other in zip(slept.averages, dense.averages, strict=True):
        torch.testing.assert_close(one, other, rtol=10 * most, atol=0)


@BOTH_AND_GPU
@pytest.mark.parametrize("mean", [math.nan, math.inf])
def test_a_value_whose_missed_steps_are_not_finite_stays(device, dtype, mean):
    place = {"device": device, "dtype": dtype}
    slept = Blocks(_rows(300, torch.Generator().manual_seed(0), place))
    before = [value.clone() for value in slept.values]
    slept.averages[0][7] = mean
    slept.averages[7].fill_(1.0)
    slept.terms[:, 1] = math.inf  # as of a rate that has overflown
    slept.averages[1].fill_(1.0)
    for step in slept.steps:
        step += 5
    slept.wake(_away(place), True, 0.01)
    assert all(map(torch.equal, slept.values[:2], before[:2]))
    assert slept.averages[0][7].isnan().all() and slept.averages[1].isnan().all()  # as an ordinary step marks them
    assert not slept.averages[0][:7].isnan().any()


def _clusters(rng: np.random.Generator, place: dict, blocks: int = 24, small: bool = False) -> Blocks:
    """A block a cluster, in a room of 10 units: balls, needles and giants, with averages at their limit.

    small: the Gaussians of a cluster are almost one, an opaque ball of any size.
    """
    count = blocks * BLOCK - int(rng.integers(BLOCK))
    values = _rows(count, torch.Generator().manual_seed(int(rng.integers(2**31))), place)
    centers = np.repeat(rng.uniform(-10, 10, (blocks, 3)), BLOCK, 0)[:count]
    spread = np.repeat(10 ** rng.uniform(-3, -2 if small else 0.3, (blocks, 1)), BLOCK, 0)[:count]
    values[0].copy_(torch.tensor(centers + spread * rng.normal(size=(count, 3))))
    needles = np.where(rng.random((count, 3)) < 0.03, rng.uniform(0, 2.5, (count, 3)), 0)
    values[2].copy_(torch.tensor(rng.uniform(-6, -1, (count, 1)) + needles))
    if small:
        values[1].fill_(12.0)
        values[2].copy_(torch.tensor(np.repeat(rng.uniform(-4, 2.5, (blocks, 1)), BLOCK, 0)[:count]))
    out = Blocks(values, step=500)
    for value, mean, square in zip(values, out.averages[:6], out.averages[6:], strict=True):
        square.fill_(1e-6)
        mean.copy_(torch.tensor(rng.choice([-1, 1], value.shape)) * MOST_RATIO * 1e-3)
    return out


def _looking(
    rng: np.random.Generator, at: np.ndarray, place: dict, lens: Lens | None = None, rays: bool = False
) -> tuple:
    """A camera near a point, or far from it, that looks anywhere."""
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    view = np.eye(4)
    view[:3, :3], view[:3, 3] = turn, -turn @ (at + rng.normal(size=3) * 10 ** rng.uniform(-2, 1))
    return _camera(torch.tensor(view), place, lens, rays)


LENSES = {
    "pinhole": None,
    "barrel": Lens("perspective", (70.0, 68.0), (47.0, 30.0), (-0.3, 0.1, 0.0, 0.0), tangential=(0.003, -0.002)),
    "pincushion": Lens("perspective", (70.0, 70.0), (60.0, 31.5), (0.1, 0.02, 0.0, 0.0), prism=(0.01, -0.02)),
    "turning back": Lens("perspective", (50.0, 50.0), (47.5, 31.5), (-0.25, 0.0, 0.0, 0.0)),
    "rational": Lens("perspective", (70.0, 70.0), (47.5, 31.5), (0.3, 0.1, 0.0, 0.0), (0.5, 0.1, 0.0)),
    "fisheye": Lens("equidistant", (40.0, 41.0), (47.0, 31.0), (0.02, -0.01, 0.001, 0.0)),
    "wide fisheye": Lens("equidistant", (34.0, 34.0), (47.5, 31.5)),
    "panorama": Lens("equirectangular", (96 / math.tau, 64 / math.pi), (47.5, 31.5)),
}


@pytest.mark.parametrize(
    ("name", "rays"), [*((name, False) for name in LENSES), ("pinhole", True), ("wide fisheye", True)]
)
@CPU_AND_GPU
def test_no_view_shows_a_block_that_sleeps(device, name, rays, dtype=torch.float32):
    place, rng, lens = {"device": device, "dtype": dtype}, np.random.default_rng(7), LENSES[name]
    asleep = woken = 0
    for trial in range(VIEWS):
        blocks = _clusters(rng, place, small=trial % 2 > 0)
        missed, rate = int(rng.integers(1, 100)), 10 ** rng.uniform(-5, -2)
        blocks.terms[:, :6] = rate
        for step in blocks.steps:
            step += missed
        camera = _looking(
            rng, blocks.values[0][int(rng.integers(len(blocks.values[0])))].cpu().numpy(), place, lens, rays
        )
        whole = Blocks([value.clone() for value in blocks.values])
        whole.averages, whole.steps = [x.clone() for x in blocks.averages], blocks.steps
        whole.taken, whole.terms = blocks.taken.clone(), blocks.terms.clone()
        whole.wake(camera, True, rate)
        blocks.wake(camera, False, rate)
        assert (whole.taken == 500 + missed).all()  # no step follows yet
        assert torch.equal(blocks.taken, torch.where(blocks.awake.bool(), 501 + missed, 500).int())
        rows = blocks.awake.bool().repeat_interleave(BLOCK)[: len(blocks.values[0])]
        for scene in (whole.scene(camera), blocks.scene(camera)):
            *_, tiles, radii = OPERATORS.project(*scene)
            assert not (tiles[~rows].any() or radii[~rows].any())
        drawn = [
            OPERATORS.rasterize(None, *scene, torch.zeros(3, **place), True, True, False, awake)
            for scene, awake in ((whole.scene(camera), None), (blocks.scene(camera), blocks.awake))
        ]
        assert all(torch.equal(one, other) for one, other in zip(*(d[:4] for d in drawn), strict=True))
        asleep, woken = asleep + int((~rows).sum()), woken + int(rows.sum())
    if rays:
        assert woken and not asleep
    elif name == "panorama":  # all but what is too near
        assert woken > 0.9 * (asleep + woken)
    else:
        assert min(asleep, woken) > 0.1 * (asleep + woken)


def test_no_view_shows_a_block_that_sleeps_in_double():
    test_no_view_shows_a_block_that_sleeps("cpu", "barrel", False, torch.float64)


def test_steps_with_sleep_are_those_of_dense_adam_in_double():
    """Gaussians that a view sees have random gradients. No other row has a gradient, or is seen."""
    place, rng, worst = {"device": "cpu", "dtype": torch.float32}, np.random.default_rng(11), [0.0, 0.0]
    for _ in range(SCENES):
        slept = _clusters(rng, place, blocks=6)
        dense = Blocks([value.double() for value in slept.values])
        dense.averages, dense.steps = [x.double() for x in slept.averages], [x.clone() for x in slept.steps]
        for number in range(1, 1 + int(rng.integers(*STEPS))):
            rate, at = 10 ** rng.uniform(-5, -2.5), int(rng.integers(len(slept.values[0])))
            camera = _looking(rng, slept.values[0][at].numpy(), place)
            slept.wake(camera, False, rate)
            rows = slept.awake.bool().repeat_interleave(BLOCK)[: len(slept.values[0])]
            *_, radii = OPERATORS.project(*slept.scene(camera))
            assert not ((radii > 0) & ~rows).any()
            gradients = [1e-3 * torch.randn_like(v) * (radii > 0).view(-1, *[1] * (v.dim() - 1)) for v in slept.values]
            moved = [*slept.values, *slept.averages]
            parts = [values[rows] for values in (*moved, *gradients)]
            lists = parts[:6], parts[18:], parts[6:12], parts[12:18], slept.steps, [rate] * 6
            adam_(*lists, *BETAS, EPS, [-1] * 6)
            for values, part in zip(moved, parts[:18], strict=True):
                values[rows] = part
            dense.step([gradient.double() for gradient in gradients], rate)
            if number % REST == 0:
                slept.wake(camera, True, rate)
        slept.wake(camera, True, rate)
        for one, other in zip(slept.values, dense.values, strict=True):
            worst[0] = max(worst[0], float(((one - other).abs() / (1 + other.abs())).max()))
        for one, other in zip(slept.averages, dense.averages, strict=True):
            worst[1] = max(worst[1], float((one - other).abs().max() / other.abs().max()))
    assert worst[0] < 2e-6 and worst[1] < 4e-6, worst


# Trainings


@pytest.fixture(scope="module")
def scene(once) -> Path:
    return shared_scene(once)


@pytest.fixture(autouse=True)
def shares() -> Iterator[list[float]]:
    with sleep(2.0) as found:
        yield found


def _trained(scene: Path, out: Path, *options: object) -> dict:
    return trained(scene, out, "--init_pcd_path", scene / "points.ply", *options)


@pytest.fixture(scope="module")
def plain(once) -> Path:
    """The folder of a training by plain steps."""
    return plain_training(once, "asleep, default")


def test_fast_steps_with_a_lens(tmp_path, take_as, shares):  # noqa: F811
    scene = with_clusters(narrow_scene(tmp_path / "scene", "OPENCV", (-0.2, 0.05, 0.001, -0.002)), 1000, 30, 200)
    expected = _trained(scene, tmp_path / "plain", "--plain_step")
    take_as("captured")
    assert not differences(_trained(scene, tmp_path / "fast"), expected) and min(shares) < 0.9


def _in_rank(scene: Path, out: Path, *options: object) -> dict:
    with sleep(2.0):
        try:
            return _trained(scene, out, *options)
        except FileNotFoundError:  # only the first rank writes
            if ranks().first:
                raise
    return {}


def test_a_rank_without_rows(scene, tmp_path):
    few = tmp_path / "few.ply"
    write_point_cloud(few, 0.7 * np.random.default_rng(0).normal(size=(100, 3)), np.full((100, 3), 128))
    words = "--init_pcd_path", few
    result, _ = in_ranks(2, _in_rank, scene, tmp_path / "ranks", *words)
    assert not differences(result, _trained(scene, tmp_path / "alone", *words))


def test_rays_have_the_bytes_of_a_training_in_which_nothing_sleeps(scene, tmp_path, monkeypatch):
    """Also with scores and saves between, and resumed."""
    words = *OPTIONS["together"], *OPTIONS["rays"]
    looks = "--test_iterations", 3, 17, 31, "--save_iterations", 9, "--checkpoint_iterations", 33, ITERATIONS
    looked = _trained(scene, tmp_path / "a", *words, *looks)
    resumed = _trained(scene, tmp_path / "b", *words, "--start_checkpoint", tmp_path / "a/chkpnt33.pth")
    monkeypatch.setattr(sleeping, "MOST_SHARE", 0.0)
    awake = _trained(scene, tmp_path / "awake", *words)
    assert looked["ply"] == resumed["ply"] == awake["ply"]


DAMAGE = {
    "rows": lambda asleep: asleep["rows"].pop(),
    "taken": lambda asleep: asleep["taken"].sub_(2**30),
    "awake": lambda asleep: asleep.update(awake=torch.tensor(0.5)),
    "terms": lambda asleep: asleep.update(terms=asleep["terms"][:5]),
}


def test_a_checkpoint_from_within_a_step_resumes_and_a_damaged_one_is_refused(scene, tmp_path, plain):
    """From within a step, as where memory has run out: the blocks that the step concerns are awake for it already."""
    start = "--start_checkpoint", tmp_path / "changed.pth"

    def save(change: Callable[[dict], object]) -> None:
        capture, iteration = load_checkpoint(plain / "chkpnt33.pth")
        change(extra_state(capture).get("sleep"))
        save_checkpoint(start[1], capture, iteration)

    save(lambda asleep: asleep["taken"].add_(asleep["awake"].int()))
    assert not differences(_trained(scene, tmp_path / "b", *start), whole_result(plain, ITERATIONS))
    for change in DAMAGE.values():
        save(change)
        with pytest.raises(UserError, match="of sleeping blocks in the checkpoint does not fit"):
            _trained(scene, tmp_path / "c", *start)


@needs_fused_step
@pytest.mark.parametrize("way", ["fused", "captured"])
def test_interrupted(scene, tmp_path, plain, monkeypatch, take_as, way):  # noqa: F811
    """Some iterations after all blocks have rested; of captured steps no Python has run since."""
    take_as(way)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        before_steps(patch, lambda step: os.kill(os.getpid(), signal.SIGINT) if step.iteration == 37 else None)
        _trained(scene, tmp_path / "cut")
    start = "--start_checkpoint", tmp_path / "cut/chkpnt37.pth"
    assert extra_state(load_checkpoint(start[1])[0]).get("sleep")
    assert not differences(_trained(scene, tmp_path / "whole", *start), whole_result(plain, ITERATIONS))


@pytest.mark.parametrize("way", [(), ("--plain_step",)])
def test_the_model_before_a_loss_of_nan_has_the_missed_steps_up_to_there(scene, tmp_path, monkeypatch, way):
    words = *way, "--densification_interval", 1000
    _trained(scene, tmp_path / "good", *words, "--checkpoint_iterations", 31, ITERATIONS)
    call = Objective.__call__

    def broken(self: Objective, package: dict, at: Iteration) -> object:
        losses = call(self, package, at)
        return losses._replace(total=losses.total * math.nan) if at.iteration == 32 else losses

    monkeypatch.setattr(Objective, "__call__", broken)
    monkeypatch.setattr(ProgressBar, "due", lambda self, step: step.last)  # so that others rest before it is found
    with pytest.raises(UserError, match=r"loss of iteration 32 .*chkpnt31.pth"):
        _trained(scene, tmp_path / "bad", *words)
    good, bad = (load_checkpoint(tmp_path / name / "chkpnt31.pth")[0] for name in ("good", "bad"))
    assert all(torch.equal(one, other) for one, other in zip(good[1:7], bad[1:7], strict=True))


@pytest.mark.parametrize("way", [(), ("--plain_step", *OPTIONS["exposure"])])
def test_a_term_that_somebody_adds_to_the_loss_reaches_all_rows(scene, tmp_path, monkeypatch, way):
    made, call, began = [], Objective.__init__, Objective.__call__
    monkeypatch.setattr(Objective, "__init__", lambda self, run: (made.append(run), call(self, run))[1])

    def more(self: Objective, package: dict, at: Iteration) -> object:
        losses = began(self, package, at)
        return losses._replace(total=losses.total + made[-1].gaussians.get_opacity.mean())

    monkeypatch.setattr(Objective, "__call__", more)
    asleep = _trained(scene, tmp_path / "asleep", *way)
    monkeypatch.setattr(sleeping, "MOST_SHARE", 0.0)
    assert not differences(asleep, _trained(scene, tmp_path / "awake", *way))


@needs_fused_step
@pytest.mark.parametrize("way", ["queued", "captured"])
def test_a_term_ends_no_sleep_before_the_queued_steps_are_done(scene, tmp_path, monkeypatch, take_as, way):  # noqa: F811
    """Once a step has halted for lack of room, a rest would do nothing, and what blocks have missed would be lost."""
    made, calls, done, ends = [], [], [], []
    make, call, end = Objective.__init__, Objective.__call__, runs.Run.stop_skipping
    monkeypatch.setattr(Objective, "__init__", lambda self, run: (made.append(run), make(self, run))[1])

    def more(self: Objective, package: dict, at: Iteration) -> object:
        losses = call(self, package, at)
        calls.append(1)
        return losses._replace(total=losses.total + (len(calls) > 10) * made[-1].gaussians.get_opacity.mean())

    class Queue(Immediate):
        def __init__(self, *arguments: object) -> None:
            super().__init__(*arguments)
            self.discard = lambda: done.append(1)

    monkeypatch.setattr(Objective, "__call__", more)
    monkeypatch.setattr(runs.Run, "stop_skipping", lambda self, *x: (ends.append(len(done)), end(self, *x))[1])
    take_as(way)
    monkeypatch.setattr(captured, "Speculation", Queue)
    _trained(scene, tmp_path)
    assert done and ends and all(ends)


def test_no_block_sleeps_where_a_report_may_change_the_model_or_it_has_activations_of_its_own(
    scene, tmp_path, monkeypatch, shares
):
    with monkeypatch.context() as patch:
        patch.setattr(train, "training_report", lambda *_: {})
        _trained(scene, tmp_path / "report")
    begin = GaussianModel.__init__

    def own(self: GaussianModel, *arguments: object) -> None:
        begin(self, *arguments)
        self.scaling_activation = lambda values: torch.exp(values)

    monkeypatch.setattr(GaussianModel, "__init__", own)
    _trained(scene, tmp_path / "own")
    assert not shares


def test_a_model_that_is_saved_between_is_as_if_no_block_had_slept(scene, tmp_path, monkeypatch):
    """Up to rounding, which a training magnifies: in few steps, from the same points."""
    words = "--save_iterations", 9, "--checkpoint_iterations", 9, ITERATIONS
    _trained(scene, tmp_path / "asleep", *words)
    monkeypatch.setattr(sleeping, "MOST_SHARE", 0.0)
    _trained(scene, tmp_path / "awake", *words)
    one, other = (read_model(tmp_path / out / "point_cloud/iteration_9/point_cloud.ply") for out in ("asleep", "awake"))
    torch.testing.assert_close(one.get_xyz, other.get_xyz, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(one.get_opacity, other.get_opacity, rtol=1e-4, atol=1e-4)
    one, other = (load_checkpoint(tmp_path / out / "chkpnt9.pth")[0] for out in ("asleep", "awake"))
    assert extra_state(one).get("sleep") and not extra_state(other).get("sleep")
    torch.testing.assert_close(one[1], other[1], rtol=1e-5, atol=1e-5)
    averages, dense = (capture[10]["state"][0]["exp_avg"] for capture in (one, other))
    assert (averages - dense).abs().max() < 1e-3 * dense.abs().max()
