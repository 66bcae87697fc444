"""Costs of features that are off: the claims of docs/results/costs.md that need no clock, and its ways to measure."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from rasterizer_tools import CPU_AND_GPU, ops

from benchmarks.costs.allocations import allocated_bytes
from benchmarks.costs.paired import difference, interleaved, median_interval
from benchmarks.costs.rows import ROWS, Row, Workload
from benchmarks.harness.page import BEGIN, END, replace_tables

ROOT = Path(__file__).parents[1]
CPU = torch.device("cpu")
SPLATS, WIDTH, HEIGHT = 500, 70, 50


@pytest.fixture(scope="module")
def work() -> Workload:
    return Workload(SPLATS, WIDTH, HEIGHT, 2.0, CPU)


@pytest.fixture(scope="module")
def rows(work) -> dict[str, Row]:
    return {make.__name__: make(work) for make in ROWS}


def _bytes(row: Row, which: str) -> int:
    return allocated_bytes(getattr(row, which), CPU)


@pytest.mark.parametrize("name", ["control", "depth", "exposure", "masks", "tensorboard"])
def test_off_allocates_what_a_call_without_the_feature_does(rows, name):
    assert _bytes(rows[name], "off") == _bytes(rows[name], "base")


def test_nothing_is_allocated_for_gradients_at_inference(rows):
    row = rows["gradient_buffers"]
    assert _bytes(row, "off") == row.base_bytes
    # Training adds the slots of each splat and their end, and the last splat of each pixel.
    assert _bytes(row, "on") - _bytes(row, "off") == 16 * (SPLATS + 1) + 4 * WIDTH * HEIGHT


def test_depth_is_allocated_on_request_only(rows):
    assert _bytes(rows["depth"], "on") - _bytes(rows["depth"], "off") == 4 * WIDTH * HEIGHT


def test_bands_that_are_not_active_take_no_part_in_a_step(rows):
    row = rows["inactive_bands"]
    # The step counters of six tensors, and of five.
    assert 0 <= _bytes(row, "off") - _bytes(row, "base") < 32
    # The model keeps values and both moments of 45 numbers, and a step counter that a model without bands lacks.
    assert row.kept[1] - row.kept[0] == pytest.approx(3 * 45 * 4 * SPLATS, abs=16)
    assert rows["unneeded_bands"].kept[1] - rows["unneeded_bands"].kept[0] == (45 - 9) * 4 * SPLATS


def test_what_is_compared_gives_the_same(work):
    model = work.model()
    assert torch.equal(work.image(model), work.bare_image(model))
    with_bands, without = work.model(degree=3, active=0), work.model(degree=0, active=0)
    assert torch.equal(work.image(with_bands), work.image(without))


@pytest.fixture(scope="module")
def probed(tmp_path_factory) -> dict:
    folder = tmp_path_factory.mktemp("probe")
    command = [sys.executable, "-m", "benchmarks.costs.probe", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_the_probe_makes_nothing_when_it_is_asked_for_help(tmp_path):
    command = [sys.executable, "-m", "benchmarks.costs.probe", "--help"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("usage: probe.py") and list(tmp_path.iterdir()) == []


def test_training_and_rendering_load_nothing_they_do_not_use(probed):
    assert probed["modules"] == []
    assert probed["binds"] == []
    assert "point_cloud/iteration_3/point_cloud.ply" in probed["files"]
    assert not [name for name in probed["files"] if "error_vs_time" in name]


def test_only_pictures_that_train_are_decoded_and_none_is_kept_larger_than_used(probed):
    assert probed["decoded"] and all(name.startswith("train/") for name in probed["decoded"])
    # The files are twice as large, and have an opaque alpha channel.
    assert probed["picture_bytes"] == [probed["values"]] * 4


@CPU_AND_GPU
def test_an_opaque_tile_takes_no_more_splats(device):
    """NaN colours would show, even with weight zero, in any tile that still reads them."""
    front, behind, tiles = 8, 600, 6  # 3 x 2 tiles
    splat = torch.tensor([20.0, 15.0, 1e-3, 0.0, 1e-3, math.log2(0.9), 0.5, 0.5, 0.5, 1.0])
    splats = splat.repeat(front + behind, 1)
    splats[front:, 6:9] = math.nan
    splats = splats.to(device)
    instances = torch.arange(front + behind, dtype=torch.int32, device=device).repeat(tiles)
    ranges = (front + behind) * torch.arange(tiles + 1, device=device)
    background = torch.zeros(3, device=device)
    color, left, _, last, _ = ops.blend(splats, instances, ranges, background, 30, 45, False, True)
    assert color.isfinite().all() and last.max() <= front and left.max() < 1e-3
    # They do show if one splat in front is less than opaque.
    splats[:front, 5] = math.log2(0.1)
    assert not ops.blend(splats, instances, ranges, background, 30, 45, False, True)[0].isfinite().any()


def test_calls_take_turns():
    said = []
    times = interleaved({name: lambda name=name: said.append(name) for name in "abc"}, 3, CPU)
    assert "".join(said) == "abc" + "bca" + "cab" + "abc"
    assert {name: len(values) for name, values in times.items()} == {"a": 3, "b": 3, "c": 3}


def test_the_interval_holds_the_median_as_often_as_it_says():
    """The interval misses if fewer than k of n draws are on one side, where k is the rank of its ends; exact."""
    for n in (5, 7, 41, 100):
        _, low, high = median_interval(range(1, n + 1))
        if math.isinf(low):
            assert 2 * 0.5**n > 0.05  # with so few, no interval reaches 95 %
            continue
        assert low + high == n + 1
        miss = 2 * sum(math.comb(n, k) for k in range(int(low))) * 0.5**n
        assert miss <= 0.05 < miss + 2 * math.comb(n, int(low)) * 0.5**n
    generator = torch.Generator().manual_seed(0)
    draws = torch.randn(400, 41, generator=generator) + 1.5
    held = sum(low <= 1.5 <= high for _, low, high in (median_interval(row.tolist()) for row in draws))
    assert 0.92 < held / 400 <= 0.99  # 95.7 % expected; standard deviation 1 %


def test_differences_are_within_noise_or_not():
    base = [10.0 + 0.1 * math.sin(k) for k in range(41)]
    assert difference([b + 0.01 * math.cos(7 * k) for k, b in enumerate(base)], base).within_noise
    slower = difference([b + 0.05 + 0.01 * math.cos(7 * k) for k, b in enumerate(base)], base)
    assert not slower.within_noise and slower.low > 0 and slower.median == pytest.approx(0.05, abs=0.01)


def test_bytes_are_counted_whether_or_not_they_are_given_back():
    def run() -> None:
        torch.empty(1000)
        torch.empty(10, dtype=torch.uint8)

    # The CPU's allocator returns exactly the requested bytes.
    assert allocated_bytes(run, CPU) == 4010


def test_tables_are_replaced_between_the_marks():
    begin, end = BEGIN.format("cpu"), END.format("cpu")
    page = f"before\n{begin}\nold\n{end}\nafter\n"
    once = replace_tables(page, "cpu", ["new", "lines"])
    assert once == f"before\n{begin}\nnew\nlines\n{end}\nafter\n"
    assert replace_tables(once, "cpu", ["new", "lines"]) == once
    ours = (ROOT / "docs/results/costs.md").read_text()
    assert all(mark.format(device) in ours for mark in (BEGIN, END) for device in ("cpu", "cuda"))
