"""The number of threads for photos: at most the number of processors that the process may use."""

import os

import pytest

from splatting.host import machine


@pytest.fixture
def made(monkeypatch, tmp_path):
    """A function that simulates a machine of 64 processors, of which the process may use some; limits by cgroup."""
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    monkeypatch.setattr(machine, "_CGROUPS", tmp_path)
    monkeypatch.setattr(machine, "_OWN_CGROUPS", tmp_path / "own")

    def make(affinity: int, own: str = "/", **limits: str) -> None:
        monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(affinity)), raising=False)
        (tmp_path / "own").write_text(f"1:cpu:/old\n0::{own}\n")
        for group, limit in limits.items():
            (tmp_path / group.replace("_", "/")).mkdir(parents=True, exist_ok=True)
            (tmp_path / group.replace("_", "/") / "cpu.max").write_text(limit)

    return make


def test_affinity(made):
    made(2)
    assert machine.cores() == machine.threads() == 2
    made(64)
    assert machine.cores() == 64 and machine.threads() == machine.MOST_THREADS and machine.threads(5) == 5


@pytest.mark.parametrize(
    ("outer", "inner", "count"),
    [
        ("max 100000", "max 100000", 8),
        ("max 100000", "250000 100000", 3),
        ("100000 100000", "400000 100000", 1),
        ("x", "5000 100000", 1),
    ],
)
def test_quota_of_the_group_and_those_around_it(made, outer, inner, count):
    made(8, "/outer/inner", outer=outer, outer_inner=inner)
    assert machine.cores() == count


def test_without_cgroups_or_affinity(made, monkeypatch, tmp_path):
    made(8)
    (tmp_path / "own").unlink()
    assert machine.cores() == 8
    monkeypatch.delattr(os, "sched_getaffinity")
    assert machine.cores() == 64
