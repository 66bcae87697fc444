"""--gpu_memory: a part of f_rest and its averages in the host's memory changes no byte, and keeps the limit."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from diff_gaussian_rasterization.optim import adam_
from gaussians import model, needs_59_values
from processes import in_ranks
from rasterizer_tools import GPU_MARKS
from trainings import (
    ITERATIONS,
    OPTIONS,
    before_steps,
    differences,
    narrow_scene,
    plain_training,
    shared_scene,
    trained,
    trained_as,
    whole_result,
    with_clusters,
)

from groundwork.ranks.ranks import ranks
from scene import sleeping
from scene.gaussians import spilled
from scene.gaussians.spilled import bytes_of, empty_rows, is_spilled
from splatting import resources, run, spill
from splatting.resources import training_bytes
from splatting.spill import GpuMemory, make_storage, resident_rows, sentences, spillable_bytes

SPILL = ("--gpu_memory", 1)
ON_A_GPU = pytest.mark.parametrize("_", [pytest.param(None, marks=GPU_MARKS)])
PAGE = 2 << 20


# The policy


@pytest.mark.parametrize("limit", [0, 10_000, 530_000, 700_000, 1_300_000, 10**9])
def test_what_stays_near_fits_beside_all_else(limit):
    near = resident_rows(limit, 1000, 530_000, 540_000)
    assert near == (0 if limit <= 530_000 else 1000 if limit >= 1_070_000 else near)
    if 0 < near < 1000:
        assert 530_000 + 540 * near <= limit < 530_000 + 540 * (near + 1)
    assert resident_rows(limit, 1000, 530_000, 0) == 1000  # degree 0 has nothing to spill


VIEW = SimpleNamespace(image_width=50, image_height=20)
SCENE = SimpleNamespace(images=None, getTrainCameras=lambda: [VIEW])


def _memory(monkeypatch: pytest.MonkeyPatch, limit: float, photos: int = 0) -> GpuMemory:
    """Return the memory of a GPU, which need not exist, with room for 50 Gaussians reserved."""
    monkeypatch.setattr(GpuMemory, "_limit_torch", lambda self, each: None)
    monkeypatch.setattr(spill, "photo_bytes", lambda images, device: photos)
    monkeypatch.setattr(spill, "free_memory", lambda device: 2**30)
    monkeypatch.setattr(torch.cuda, "memory_allocated", lambda device: 0)
    monkeypatch.setattr(torch.cuda, "memory_reserved", lambda device: 0)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (2**31, 2**32))
    memory = GpuMemory(limit, model(50), False, torch.device("cuda"))
    memory.limit_for(50, SCENE)
    return memory


@needs_59_values
def test_the_share_follows_the_number_of_gaussians(monkeypatch):
    gaussians, count, pixels = model(1), 10**6, 1000
    assert training_bytes(gaussians, count, 0) == count * (12 * 59 + 4 * 45 + resources.PER_GAUSSIAN)
    assert spillable_bytes(gaussians, count) == count * 12 * 45
    memory = _memory(monkeypatch, 1, photos=2**27)
    shares = [memory.resident_rows(count) / count for count in range(10**5, 4 * 10**6, 10**5)]
    assert shares[0] == 1 and shares[-1] == 0 and shares == sorted(shares, reverse=True)
    count = 1_200_000
    near = memory.resident_rows(count)
    fixed = pixels * resources.PER_PIXEL + 2**27 + spill._LEAST_SPARE
    others = count * (12 * 14 + resources.PER_GAUSSIAN + spill._WHOLE_STEP) + fixed
    assert abs(near - resident_rows(2**30, count, others, count * 540)) <= 1 and 0 < near < count
    # Where the copy that a change needs does not fit, all rows may stay, but as spilled ones.
    whole = next(count for count in range(10**5, 10**7, 10**4) if memory._spills(count))
    assert memory.resident_rows(whole) == whole
    fit = [training_bytes(gaussians, n, 0) + n * spill._WHOLE_STEP + fixed <= 2**30 for n in (whole, whole - 10**4)]
    assert fit == [False, True]
    assert memory.host_bytes(count) == 540 * (count - near)
    assert _memory(monkeypatch, 0).resident_rows(10**9) == 10**9


@needs_59_values
def test_a_limit_begins_where_the_gpu_has_too_little(monkeypatch):
    memory = _memory(monkeypatch, 0)
    memory.limit_for(500_000, SCENE)
    assert memory.limit == 0 == memory.host_bytes(500_000)
    assert memory.remedy(1000, 540_000) == "set --gpu_memory, or " and memory.remedy(1000, 540_001) == ""
    memory.limit_for(1_300_000, SCENE)
    assert memory.limit == int(spill._USABLE * 2**30)
    said = sentences(memory, 1_300_000, 0.02, True)
    assert len(said) == 1 and "GiB of 1,300,000 Gaussians are kept in the host's memory" in said[0]
    assert said[0].endswith("the saved files are the same")
    memory.limit_for(10**9, SCENE)  # no other limit
    assert memory.limit == int(spill._USABLE * 2**30) and memory.remedy(1000, 1) == ""
    there = GpuMemory(0.0, model(50), False, torch.device("cpu"))
    there.limit_for(10**12, SCENE)
    assert there.limit == 0 and there.remedy(1000, 1) == ""


def test_torch_gets_the_limit_without_the_near_parts(monkeypatch):
    found, total, living, freed = [], 4 * 2**30, 100, []
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: SimpleNamespace(total_memory=total))
    monkeypatch.setattr(torch.cuda, "set_per_process_memory_fraction", lambda share: found.append(share * total))
    monkeypatch.setattr(torch.cuda, "memory_reserved", lambda device: 2**30 - 1000)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (total, total))
    monkeypatch.setattr(torch.cuda, "empty_cache", lambda: freed.append(found[-1:]))
    monkeypatch.setattr(torch.cuda, "get_per_process_memory_fraction", lambda: 1.0)
    monkeypatch.setattr(spill, "_before", [])
    monkeypatch.setattr(spill, "bytes_of", lambda: (living, 0))
    memory = GpuMemory(1.0, model(50), False, torch.device("cuda"))
    memory._limit_torch(800)
    living = 1100
    memory._limit_torch(200)
    assert found == [2**30 - 100, 2**30 - 800, 2**30 - 1100] and freed == [[2**30 - 800]]


def test_a_training_leaves_torch_what_it_had(monkeypatch):
    """At its end; of one that was refused before it began, when the next one begins."""
    share, total = [0.4], 1000
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: SimpleNamespace(total_memory=total))
    monkeypatch.setattr(torch.cuda, "get_per_process_memory_fraction", lambda: share[-1])
    monkeypatch.setattr(torch.cuda, "set_per_process_memory_fraction", share.append)
    monkeypatch.setattr(torch.cuda, "memory_reserved", lambda device: 0)
    monkeypatch.setattr(spill, "_before", [])
    spill.release_torch()
    assert share == [0.4]
    for limit in (100, 200):
        spill.limit_torch(limit, torch.device("cuda"))
    spill.release_torch()
    assert share == [0.4, 0.1, 0.2, 0.4]
    spill.limit_torch(300, torch.device("cuda"))
    assert make_storage(model(50), SimpleNamespace(gpu_memory=0.0), torch.device("cpu"), False) is None
    assert share == [0.4, 0.1, 0.2, 0.4, 0.3, 0.4]


def test_the_cpu_has_one_memory():
    values = torch.ones(4, 3)
    assert empty_rows(values, 5, 1) is None and bytes_of(values) == bytes_of() == (0, 0) and not is_spilled(values)
    for rows in (-1, 2**31):
        with pytest.raises(ValueError, match="at least 0"):
            empty_rows(values, rows, 0)


# Trainings


@pytest.fixture(scope="module")
def scene(once) -> Path:
    return shared_scene(once)


@contextmanager
def _half_spilled(patch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """Let half of the rows be spilled. Where there is no GPU, tensors of the CPU stand for spilled ones.

    Yields the numbers of rows of the tensors that were made.
    """
    made, kept, make, bytes_found = [], [], spilled.OPERATORS.spilled, spilled.OPERATORS.spilled_bytes

    def stand_in(like: torch.Tensor, rows: int, near: int) -> torch.Tensor:
        made.append(rows)
        if like.is_cuda:
            return make(like, rows, near)
        kept.append((torch.full((rows, *like.shape[1:]), torch.nan), near))
        return kept[-1][0]

    def found(values: torch.Tensor | None = None) -> torch.Tensor:
        if values is None or values.is_cuda:
            return bytes_found(values)
        inside = [n for t, n in kept if 0 <= values.data_ptr() - t.data_ptr() < max(t.numel() * t.element_size(), 1)]
        return torch.tensor([inside[0], 1] if inside else [0, 0])

    patch.setattr(spilled.OPERATORS, "spilled", stand_in)
    patch.setattr(spilled.OPERATORS, "spilled_bytes", found)
    patch.setattr(GpuMemory, "resident_rows", lambda self, count: count // 2)
    patch.setattr(GpuMemory, "_spills", lambda self, count: self.limit > 0)
    patch.setattr(spill, "refuse_without_gpu", lambda device: None)
    patch.setattr(spill, "_PAGE", PAGE if torch.cuda.is_available() else 1)
    yield made


def _check_rows(patch: pytest.MonkeyPatch) -> list[int]:
    """Check before each step that f_rest and its averages are spilled. The numbers of rows."""
    counts, set_rates = [], run.Run.set_rates

    def checked(self: run.Run, step: object) -> None:
        set_rates(self, step)
        gaussians = self.gaussians
        counts.append(len(gaussians))
        if gaussians._features_rest.numel():
            assert is_spilled(gaussians._features_rest.detach()) and not is_spilled(gaussians._xyz.detach())
            state = gaussians.optimizer.state.get(gaussians._features_rest, {})
            assert all(is_spilled(state[name]) for name in ("exp_avg", "exp_avg_sq") if state)

    patch.setattr(run.Run, "set_rates", checked)
    return counts


@pytest.mark.parametrize("name", ["asleep, default", "asleep, together", "asleep, budget", "sparse", "mcmc"])
def test_spilled_rows_are_trained_as_any_others(scene, tmp_path, monkeypatch, once, name):
    """Resumed, too: with spilled rows by a training without, and the other way round."""
    expected = whole_result(plain_training(once, name), ITERATIONS)
    with monkeypatch.context() as patch, _half_spilled(patch) as made:
        counts = _check_rows(patch)
        words = *SPILL, "--checkpoint_iterations", 33, ITERATIONS
        assert not differences(trained_as(name, scene, tmp_path / "a", *words), expected)
        assert {*counts} <= {*made} and len({*counts}) > 1
        if name == "asleep, default":
            start = "--start_checkpoint", plain_training(once, name) / "chkpnt33.pth"
            assert not differences(trained_as(name, scene, tmp_path / "b", *SPILL, *start), expected)
    if name == "asleep, default":
        start = "--start_checkpoint", tmp_path / "a/chkpnt33.pth"
        assert not differences(trained_as(name, scene, tmp_path / "c", *start), expected)


def _in_ranks(scene: Path, folder: Path) -> dict | None:
    with pytest.MonkeyPatch.context() as patch, _half_spilled(patch):
        _check_rows(patch)
        try:
            return trained_as("asleep, default", scene, folder / "ranks", *SPILL)
        except FileNotFoundError:  # only the first rank writes
            if ranks().first:
                raise
    return None


def test_ranks(scene, tmp_path, once):
    expected = whole_result(plain_training(once, "asleep, default"), ITERATIONS)
    assert not differences(in_ranks(2, _in_ranks, scene, tmp_path)[0], expected)


@pytest.mark.parametrize(("options", "sleeps"), [((), False), (SPILL, True), ((*SPILL, "--strategy", "mcmc"), False)])
def test_blocks_sleep_wherever_they_can(scene, tmp_path, monkeypatch, options, sleeps):
    monkeypatch.setattr(sleeping, "MOST_SHARE", 0.0)
    monkeypatch.setattr(spill, "refuse_without_gpu", lambda device: None)
    found, begin = [], run.Run.open
    monkeypatch.setattr(run.Run, "open", lambda self, *x: (found.append(self.sleeping is not None), begin(self, *x)))
    trained(scene, tmp_path, *options)
    assert found == [sleeps]


# On a GPU


def _filled(shape: tuple[int, ...]) -> torch.Tensor:
    generator = torch.Generator("cuda").manual_seed(0)
    return torch.randn(shape, generator=generator, device="cuda")


@ON_A_GPU
@pytest.mark.parametrize("near", [0, 9_000_000, 10**9])
def test_a_spilled_tensor_is_as_any_other(near, _):
    before, values = bytes_of(), _filled((100_003, 15, 3))
    made = empty_rows(values, len(values), near).copy_(values)
    size = values.numel() * 4
    there = bytes_of(made[7:])
    assert there[0] == min(near // PAGE * PAGE, -(-size // PAGE) * PAGE) and size <= sum(there) < size + 2 * PAGE
    assert bytes_of() == tuple(a + b for a, b in zip(before, there, strict=True)) and not any(bytes_of(values))
    assert torch.equal(made, values) and torch.equal(made.cpu(), values.cpu()) and torch.equal(made.clone(), values)
    order = torch.randperm(len(values), device="cuda")
    out = empty_rows(values, len(values), near)
    torch.index_select(made, 0, order, out=out)
    assert torch.equal(out, values[order]) and torch.equal(made[order[:9]], values[order[:9]])
    made.index_copy_(0, order[:500], values[:500])
    values.index_copy_(0, order[:500], values[:500].clone())
    assert torch.equal(made, values)
    torch.cat((made[:60_000], values[60_000:]), out=out)
    assert torch.equal(out, values) and not out.zero_().any()
    made.copy_(values.cpu())  # from memory that is not locked
    states = [[t, torch.zeros_like(t), torch.zeros_like(t)] for t in (values.clone(), made)]
    states[1][1:] = (empty_rows(values, len(values), near).zero_() for _ in range(2))
    for value, mean, square in states:
        for step in range(3):
            adam_([value], [values], [mean], [square], [torch.tensor(float(step))], [0.01], 0.9, 0.999, 1e-15, [45])
    assert all(torch.equal(one, other) for one, other in zip(*states, strict=True))


@ON_A_GPU
def test_memory_is_given_back(_):
    values = _filled((1, 15, 3))
    free, before = torch.cuda.mem_get_info()[0], bytes_of()
    made = [empty_rows(values, 10**6, 90_000_000).fill_(k) for k in range(3)]
    assert torch.cuda.mem_get_info()[0] < free - 3 * 80e6
    assert [float(one[-1, -1, -1]) for one in made] == [0, 1, 2]
    del made
    assert bytes_of() == before and torch.cuda.mem_get_info()[0] > free - 10e6


@ON_A_GPU
@pytest.mark.parametrize("name", ["default", "absgrad", "mcmc", "budget", "sparse"])
def test_both_memories_give_the_bytes_of_one(tmp_path, monkeypatch, name, _):
    """With as many rows as pages need, more of them by density control, and half of them on the host."""
    scene = with_clusters(narrow_scene(tmp_path / "scene"), 40_000, 20, 2000)
    more = ("--strategy", "mcmc") if name == "mcmc" else OPTIONS[name]
    more += ("--max_num_splats", 90_000) if name in ("budget", "mcmc") else ()
    more += "--init_pcd_path", scene / "points.ply"
    monkeypatch.setattr(sleeping, "MOST_SHARE", 2.0)
    expected = trained(scene, tmp_path / "usual", *more)
    gc.collect()
    before = bytes_of()
    with _half_spilled(monkeypatch):
        counts = _check_rows(monkeypatch)
        assert not differences(trained(scene, tmp_path / "spilled", *SPILL, *more), expected)
    gc.collect()
    assert len({*counts}) > 1 and bytes_of() == before


@ON_A_GPU
def test_a_tight_limit_is_kept(tmp_path, monkeypatch, _):
    scene = with_clusters(narrow_scene(tmp_path / "scene"), 300_000, 20, 15_000)
    shares, peaks = [], []
    before_steps(monkeypatch, lambda step: shares.append(bytes_of()))
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    empty_rows = GpuMemory.empty_rows

    def noted(self: GpuMemory, like: torch.Tensor, rows: int) -> torch.Tensor | None:
        made = empty_rows(self, like, rows)
        peaks.append(torch.cuda.memory_reserved() + bytes_of()[0])
        return made

    monkeypatch.setattr(GpuMemory, "empty_rows", noted)
    trained(scene, tmp_path / "out", "--init_pcd_path", scene / "points.ply", "--gpu_memory", 0.7)
    assert all(near > 0 and far > 0 for near, far in shares)
    assert max(peaks) <= 0.7 * 2**30 and torch.cuda.max_memory_reserved() <= 0.7 * 2**30
