"""Benchmarks over ranks: what they draw, how they part the time of a step and count bytes, and what tables say."""

import argparse
import json
from statistics import median

import pytest
import torch
from processes import in_ranks

from benchmarks.parallel import host, spill, steps, workload
from benchmarks.parallel.stages import Stages
from benchmarks.parallel.table import best, ratios

SMALL = {"gaussians": 1000, "size": (64, 40)}
SHORT = argparse.Namespace(warm_up=2, block=2, blocks=3, staged=2)


@pytest.mark.parametrize("name", ["XL", "city"])
def test_ranks_draw_together_what_one_process_draws(name, monkeypatch):
    monkeypatch.setattr(workload, "_PIECE", 300)
    scene = workload.ALL[name].changed(**SMALL)
    whole = scene.rows(0, 1, torch.device("cpu"))
    parts = [scene.rows(rank, 3, torch.device("cpu")) for rank in range(3)]
    for attribute, values in whole.items():
        assert len(values) == 1000 and torch.equal(torch.cat([part[attribute] for part in parts]), values)


def test_a_stage_in_another_one_does_not_count_for_that_one(monkeypatch):
    clock = iter(range(100))
    monkeypatch.setattr("benchmarks.parallel.stages.time.perf_counter", lambda: next(clock))
    stages = Stages(torch.device("cpu"))
    inner = stages._around("inner", lambda: next(clock))  # 2 of the clock
    outer = stages._around("outer", lambda: (inner(), inner()))
    stages.mark()
    outer()
    stages.mark()
    assert stages.milliseconds() == {"inner": 4000, "outer": 3000, "rest": 2000}


def _measured(parallel: str) -> str:
    torch.set_num_threads(1)
    return json.dumps(steps.measure(workload.CITY.changed(**SMALL), parallel, SHORT))


@pytest.mark.parametrize("parallel", ["tiles", "views"])
def test_two_ranks_are_measured(parallel):
    found = json.loads(in_ranks(2, _measured, parallel)[0])
    assert found["ranks"] == 2 and found["views"] == (2 if parallel == "views" else 1)
    for own in found["by_rank"]:
        assert len(own["ms"]) == 3 and min(own["ms"]) > 0
        assert {"blend", "rows back", "backward of blend"} < set(own["stages"])
        assert own["sent"]["rows back"] > 0 and own["sent"].get("blend", 0) == 0
    alone = json.loads(_measured("tiles"))
    rows = ratios(best([{"link": 0.0, "results": [alone]}]) + best([{"link": 1e9, "results": [found]}]))
    times = median(alone["by_rank"][0]["ms"]) * found["views"] / steps.milliseconds(found)
    assert [row[-1] for row in rows] == ["1.00", f"{times:.2f}"]


def test_the_host_is_profiled_by_step():
    profile = host.profiled(workload.CITY.changed(**SMALL), "tiles", 3)
    rows = profile.rows(1000)
    assert profile.milliseconds > 0
    (calls,) = [calls for name, calls, _ in rows if name.startswith("take (steps/fused.py")]
    assert calls == "1.0"
    assert [float(row[2]) for row in rows] == sorted((float(row[2]) for row in rows), reverse=True)


def test_spilled_trainings_have_the_digest_of_others():
    found = [
        spill.train(argparse.Namespace(**SMALL, crop=2, iterations=iterations, cap=0, spill=spilled))["digest"]
        for iterations, spilled in ((8, False), (8, True), (9, False))
    ]
    assert found[0] == found[1] != found[2]
