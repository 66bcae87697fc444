"""A training has the same bytes by every way to take its steps, resumed, scored between, and on any ranks and threads.

Features have no such tests of their own: an option that has a part in steps or in checkpoints is in trainings.OPTIONS.
"""

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from itertools import combinations
from math import inf
from pathlib import Path

import numpy as np
import pytest
import torch
from diff_gaussian_rasterization import ops
from processes import in_ranks
from rasterizer_tools import GPU_MARKS
from step_ways import Rerun, fused_iterations, take_as  # noqa: F401  (a fixture)
from torch.utils._python_dispatch import TorchDispatchMode
from trainings import (
    EDGES,
    ITERATIONS,
    LOOKS,
    OPTIONS,
    PART_OPTIONS,
    differences,
    leaves,
    plain_training,
    shared_scene,
    sleep,
    trained,
    trained_as,
    whole_result,
)

import train
from arguments.features import strategies
from groundwork.ranks.ranks import ranks
from scene.readers.point_cloud import write_point_cloud
from splatting import log
from splatting.registry import PARTS
from utils.system_utils import UserError

Result = dict[str, bytes | list]
EVERY = pytest.mark.parametrize("name", OPTIONS)
# Captured steps are those of all options. These have every term, every optimiser, and every way to change rows.
COVERING = (
    "together",
    "appearance",
    "sparse",
    "budget",
    "points and poses",
    "asleep, together",
    "asleep, budget",
)
FUSED = (*COVERING, "mcmc", "sky", "robust mask", "points")
# Whose steps are queued one call after the other.
WITHOUT_GRAPHS = ("depth", "together", "poses, no graph", "points")
WITHOUT_GRAPHS += "robust mask", "points and poses", "sky"
# What torch leaves to MKL, which takes other code on a processor by Intel than on one by AMD, and so gives other bits.
MAKERS_OWN = {"exp", "log", "log2", "log10", "sqrt", "sin", "cos", "tan", "tanh", "asin", "acos", "atan", "erf", "erfc"}
MAKERS_OWN |= {"erfinv", "mm", "bmm", "baddbmm", "addbmm", "addmm", "mv", "addmv", "dot", "vdot", "convolution"}
OWN = "linalg_vector_norm", "linalg_cross"


@pytest.fixture(scope="module")
def scene(once) -> Path:
    return shared_scene(once)


@pytest.fixture(scope="module")
def plain(once) -> Callable[[str], Result]:
    return lambda name: whole_result(plain_training(once, name), ITERATIONS)


@pytest.mark.slow
def test_each_training_is_another(scene, tmp_path, plain):
    results = [plain(name)["ply"] for name in OPTIONS] + [trained_as("default", scene, tmp_path, "--seed", 6)["ply"]]
    assert len(set(results)) == len(OPTIONS) + 1


@pytest.mark.parametrize(
    ("way", "name"),
    [
        *(("captured", name) for name in OPTIONS),
        *(("fused", name) for name in FUSED),
        *(("queued", name) for name in ("appearance", "budget")),  # captured are those WITHOUT_GRAPHS so, too
    ],
)
def test_fast_steps(scene, tmp_path, monkeypatch, take_as, plain, way, name):  # noqa: F811
    """They write no gradient of a parameter, and no bit of fused ones depends on the processor's maker."""
    expected = plain(name)
    take_as(way)
    monkeypatch.setattr(ops, "gradients_of", lambda *_: pytest.fail("autograd has asked for gradients"))
    monkeypatch.setattr(log, "BAR_SECONDS", inf)  # else the clock decides which steps the bar reads: no graphs
    fused = fused_iterations(monkeypatch)
    with _NoneOfMakers() if way == "fused" and "asleep" not in name else nullcontext():
        found = trained_as(name, scene, tmp_path)
    assert not differences(found, expected)
    assert fused == [*range(1, ITERATIONS + 1)]
    launches = sum(made.launches for made in Rerun.made)
    if way != "captured" or name.removeprefix("asleep, ") in WITHOUT_GRAPHS:
        assert launches == 0
        return
    assert launches > 40
    assert Rerun.made[0].records >= 3  # tensors that density control has replaced are captured anew


class _NoneOfMakers(TorchDispatchMode):
    """Fails where bits depend on the processor's maker. NumPy's products and what C++ calls are not seen.

    A float64 root passes, as that of `portable_math.root`, which rounds it.
    """

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func._overloadpacket.__name__.strip("_").removeprefix("foreach_")
        if name == "pow" and isinstance(args[1], float) and args[1] == 0.5:
            name = "sqrt"
        own = name in MAKERS_OWN or (name.startswith(("linalg", "fft")) and name not in OWN)
        of_double = name == "sqrt" and getattr(args[0], "dtype", None) == torch.float64
        if func.namespace == "aten" and own and not of_double:
            pytest.fail(f"{name} of {args[0]}")
        return func(*args, **(kwargs or {}))


@EVERY
@pytest.mark.parametrize("_", [pytest.param(None, marks=GPU_MARKS)])
def test_steps_of_a_gpu(scene, tmp_path, name, _):
    expected = trained_as(name, scene, tmp_path / "plain", "--plain_step")
    assert not differences(trained_as(name, scene, tmp_path / "captured"), expected)


def _goes_together(*names: str) -> bool:
    """Tell whether a training may have these parts, at most one of which is a strategy."""
    if len({*names} & {*strategies()}) > 1:
        return False
    words = [str(word) for name in names for word in PART_OPTIONS[name]]
    try:
        train.parse(["-s", "scene", *words])
    except UserError:
        return False
    return True


def _covering(pairs: set[frozenset[str]]) -> Iterator[list[str]]:
    """Few sets of parts, of which one at least has both parts of each pair."""
    left, names = {*pairs}, [*PART_OPTIONS]
    while left:
        chosen = sorted(min(left, key=sorted))
        for name in sorted(names, key=lambda name: -sum(name in pair for pair in left)):
            if all(frozenset((name, one)) in pairs for one in chosen):
                chosen.append(name)
        left -= {frozenset(pair) for pair in combinations(chosen, 2)}
        yield chosen


def test_pairs_of_parts_resumed(scene, tmp_path):
    begin = {part.name for part in PARTS if {"begin", "state"} & {*vars(part)}}
    # test_more_photos.py has the first; the second keeps nothing, and test_resumed has the last.
    assert begin - {"resume", "remote_viewer", "sleep"} <= PART_OPTIONS.keys()
    pairs = {frozenset(pair) for pair in combinations(PART_OPTIONS, 2) if _goes_together(*pair)}
    assert len(pairs) > 44
    for names in _covering(pairs):
        out = tmp_path / "+".join(names)
        words = [word for name in names for word in PART_OPTIONS[name]]
        with sleep(0.0):
            whole = trained(scene, out, *words, "--checkpoint_iterations", 33, ITERATIONS)
            resumed = trained(scene, out / "on", *words, "--start_checkpoint", out / "chkpnt33.pth")
        assert not differences(resumed, whole), names


RESUMED = {  # other names change rows as these do, and test_pairs_of_parts_resumed has the states of parts
    **{"together": (19, 20, 29, 30, 59), "sparse": (20, 33), "mcmc idle": (20, 59), "mcmc sparse": (33,)},
    **{"budget": (19, 20, 59), "exposure and sizes": (33,), "asleep, default": (19, 20, 33, 42, 59)},
}


@pytest.mark.parametrize(("name", "edges"), RESUMED.items())
def test_resumed(scene, tmp_path, once, plain, name, edges):
    """By fast steps, from checkpoints of plain ones."""
    for edge in edges:
        start = "--start_checkpoint", plain_training(once, name) / f"chkpnt{edge}.pth"
        assert not differences(trained_as(name, scene, tmp_path / str(edge), *start), plain(name)), edge


@pytest.mark.parametrize("name", ["default", "asleep, default"])
def test_scores_saves_and_checkpoints_between_change_nothing(scene, tmp_path, once, plain, name):
    """They are those of plain steps. Elsewhere plain steps with them have the bytes of fast ones without."""
    folders = tmp_path, plain_training(once, name)
    assert not differences(trained_as(name, scene, tmp_path, *LOOKS), plain(name))
    for iteration in (9, 44):
        plys = [folder / f"point_cloud/iteration_{iteration}/point_cloud.ply" for folder in folders]
        assert plys[0].read_bytes() == plys[1].read_bytes()
    for iteration in EDGES:
        found = [leaves(torch.load(folder / f"chkpnt{iteration}.pth", weights_only=False)) for folder in folders]
        assert found[0] == found[1], iteration


def _all(scene: Path, folder: Path, kinds: list[tuple[str, tuple[str, ...]]]) -> list[Result]:
    """All trainings in the same processes; results of the first rank."""
    results = []
    for number, (name, more) in enumerate(kinds):
        try:
            results.append(trained_as(name, scene, folder / str(number), *more))
        except FileNotFoundError:
            if ranks().first:
                raise
    return results


@pytest.mark.parametrize("size", [2, 3])
def test_ranks(scene, tmp_path, once, plain, size):
    """With all that a kind may have of its own: terms, optimisers, strategies, cameras, and images of one tile."""
    names = "sparse", "appearance", "tiny", "together", "mcmc", "budget", "poses"
    kinds = [(name, ()) for name in (*names, "asleep, together", "asleep, budget")]
    kinds.append(("exposure", ("--plain_step",)))
    start = plain_training(once, "asleep, default") / "chkpnt33.pth"
    if size == 3:
        kinds = [("asleep, default", ()), ("asleep, default", ("--start_checkpoint", start))]
    found = in_ranks(size, _all, scene, tmp_path, kinds)[0]
    for (name, more), result in zip(kinds, found, strict=True):
        assert not differences(result, plain(name)), (name, more)


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["adc", "mcmc", "budget"])
def test_any_number_of_threads(scene, tmp_path, threads, strategy):
    """With as many points and pixels as torch divides loops between threads: from 32,768 values on."""
    rng, count = np.random.default_rng(0), 40_003
    write_point_cloud(tmp_path / "cloud.ply", rng.normal(size=(count, 3)), rng.integers(0, 255, (count, 3)))
    more = "--strategy", strategy, "--init_pcd_path", tmp_path / "cloud.ply", "--densify_grad_threshold", 5e-5
    more += "--max_num_splats", 50_000, "-r", 160
    results = []
    for number in (1, 2):
        threads(number)
        with sleep(0.0):
            results.append(trained(scene, tmp_path / str(number), *more))
    assert not differences(*results)
    assert len(results[0]["ply"]) > count * 4 * 14
