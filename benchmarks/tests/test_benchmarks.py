"""Benchmarks: every command on a tiny case, and what their tables and figures make of numbers."""

import json
import sys
from collections import Counter
from functools import partial
from pathlib import Path

import pytest
import stand_ins
import torch
from gaussians import model
from torch.profiler import ProfilerActivity, profile

import train
from applications.evaluation.configs import read_configs
from benchmarks.accuracy import census, hashes, oracle
from benchmarks.accuracy.runs import CPU_DOUBLE, CPU_FLOAT, CUDA_FLOAT
from benchmarks.kernels import rasterizer
from benchmarks.parallel import steps
from utils.system_utils import UserError


def _calls(iterations: int, options: list[str], out: Path) -> Counter[str]:
    """Calls of a training by name: operators, and steps of autograd as "node"."""
    words = ["-m", str(out), "--iterations", str(iterations), "--test_iterations", "-1", "--quiet", *options]
    with profile(activities=[ProfilerActivity.CPU]) as profiled:
        train.main(words)
    node = "autograd::engine::evaluate_function"
    names = ("node" if event.name.startswith(node) else event.name for event in profiled.events())
    ours = ("aten::", "diff_gaussian_rasterization::", "fused_ssim::", "node")
    return Counter(name for name in names if name.startswith(ours))


def test_an_iteration_makes_few_calls(colmap_scene, tmp_path):
    """Each call slows a step that is bound by the host, so this test must notice added calls."""
    options = ["-s", str(colmap_scene), "-r", "24"]
    found = _calls(25, options, tmp_path / "long")
    found.subtract(_calls(5, options, tmp_path / "short"))
    calls = {name: count / 20 for name, count in found.items()}
    for op in ("rasterize", "apply_gradients_"):
        assert calls[f"diff_gaussian_rasterization::{op}"] == 1, op
    assert calls["fused_ssim::photometric"] == calls["fused_ssim::photometric_vjp"] == 1
    assert calls.pop("node") <= 2  # the loss, and the image that it is differentiated by
    assert sum(calls.values()) <= 70  # and some 20 for the order of the views, drawn once an epoch of 17


def _rows(said: str, first: str) -> list[list[str]]:
    lines = [line for line in said.splitlines() if line.startswith(f"| {first}")]
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]


@pytest.mark.parametrize("path", sorted((Path(__file__).parents[2] / "benchmarks/sets").glob("*.json")), ids=str)
def test_sets_are_options_of_training(path):
    assert read_configs(path, train.parse)


def test_the_kernels_are_timed(colmap_scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(rasterizer.CPU_WORKLOADS, "S", (300, 40, 27, 2.4))
    words = "rasterizer --device cpu --workloads S --threads 1 --repeats 1"
    monkeypatch.setattr(sys, "argv", words.split())
    rasterizer.main()
    (row,) = _rows(capsys.readouterr().out, "S: 0 k, 40x27")
    assert all(float(cell) >= 0 for cell in row[2:9])
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", sys.stdout)  # training stamps it
        train.main(["-s", str(colmap_scene), "-m", str(tmp_path / "model"), "-r", "24", "--iterations", "3"])
    monkeypatch.setattr(sys, "argv", words.replace("--workloads S", f"--models {tmp_path}/model").split())
    rasterizer.main()
    (row,) = _rows(capsys.readouterr().out, "model: 0 k, 24x16")
    assert float(row[11]) > 0
    monkeypatch.setattr(sys, "argv", words.replace(" S ", " M+ ").split())
    with pytest.raises(UserError, match="M\\+: on this device there are S, M, L, wide"):
        rasterizer.main()


@pytest.mark.slow
def test_steps_of_ranks_and_of_a_spilled_model_stand_beside_those_of_one_process(monkeypatch, capsys):
    launch = steps.launch  # one rank needs no process of its own
    here = lambda case, limit: steps.measure(case) if case["ranks"] == 1 else launch(case, limit)  # noqa: E731
    monkeypatch.setattr(steps, "launch", here)
    monkeypatch.setattr("splatting.spill.refuse_without_gpu", lambda device: None)
    found = []
    for words in ("--ranks 1 2", "--model sleep spill --learn --cap 0.001"):
        words += " --size 64 40 --rounds 1 --warm_up 2 --blocks 2 --workload city --gaussians 1000 --crop 2"
        monkeypatch.setattr(sys, "argv", ["steps", *words.split()])
        steps.main()
        found += _rows(capsys.readouterr().out, "city")
    assert [row[1:3] for row in found[:2]] == [["1", "gpu"], ["2", "gpu"]]
    assert found[0][6] == "1.00" and float(found[1][3]) > 0 and found[2][-1] == found[3][-1] != ""


def test_runs_agree_with_the_oracle_and_are_reported(monkeypatch, capsys):
    monkeypatch.setattr(oracle, "KINDS", {k: partial(v, 40, 30, 20) for k, v in oracle.KINDS.items()})
    assert oracle.TIMED_SIZES.keys() == oracle.KINDS.keys()
    records, runs = oracle.measure(times=False)
    for record in records:
        bound = 1e-6 if record["kernel"] == "CPU float64" else 1e-3  # far from both, so that a mix-up shows
        assert {name for name, (largest, median) in record["errors"].items() if not median <= largest < bound} == set()
    assert max(record["errors"]["color"][0] for record in records if "float32" in record["kernel"]) > 1e-8
    oracle.print_errors(records)
    said = capsys.readouterr().out
    assert said.count("| d screen mean ") == 2 and "ordinary, CPU float64" in said
    # Without a GPU the double kernel replaces it, so that every ratio is zero; then the float kernel.
    for kernel, ratio in ((CPU_DOUBLE, "0.00"), (CPU_FLOAT, "1.00")):
        oracle.print_ratios(runs | {(case, CUDA_FLOAT): runs[case, kernel] for case in oracle.CASES})
        assert f"where either error exceeds 1e-06: {ratio} (at most 3 allowed)" in capsys.readouterr().out


def test_equal_letters_are_equal_bytes(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(hashes, "TRAININGS", {"default": "--iterations 2", "seed": "--iterations 2 --seed 1"})
    monkeypatch.setattr(hashes, "_SCENE", (3, 32, 24, 60, 0))
    monkeypatch.setattr(hashes, "run_child", stand_ins.run_here)
    stored, words = tmp_path / "other.jsonl", ["hashes", "--device", "cpu"]
    monkeypatch.setattr(sys, "argv", words)
    hashes.main()
    first = json.loads(capsys.readouterr().out)
    stored.write_text(json.dumps(first | {"sha256": first["sha256"] | {"seed": "0" * 64}}))
    monkeypatch.setattr(sys, "argv", [*words, "--compare", str(stored)])
    hashes.main()
    said = capsys.readouterr()
    rows = [line.strip("|").split("|")[-4:] for line in said.err.splitlines() if line.startswith("|")]
    assert json.loads(said.out)["sha256"] == first["sha256"]
    assert [[cell.strip() for cell in row] for row in rows[2:]] == [["A", "A", "A", "A"], ["A", "A", "A", "B"]]
    stored.write_text("{}")
    with pytest.raises(UserError, match="--compare"):
        hashes.main()


def test_the_command_prints_quantiles_cases_and_what_no_case_covers(tmp_path, monkeypatch, capsys):
    gaussians, file = model(50), tmp_path / "a.ply"
    with torch.no_grad():
        gaussians.raw("scaling")[:, 0] += 8  # needles of ratios that the first cases do not have
    gaussians.save_ply(file)
    monkeypatch.setattr(census, "CASES", census.CASES[:2])
    monkeypatch.setattr(sys, "argv", ["census", f"thin={file}", str(file), "--figure", str(tmp_path / "a.png")])
    census.main()
    said = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in said.splitlines() if line.startswith("| ")]
    assert [row[1] for row in rows if row[0] == "thin"][:5] == list(census.AXES.values())
    assert "thin: 50 Gaussians, 8 made views" in said and [row for row in rows if row[0] == "a"]
    assert [row[1][:5] for row in rows if row[0] == "needles, axes 1 : 1e+02"] == ["100 ("]
    assert [row for row in rows if row[0] == "thin" and row[-1].endswith("%")]
    assert (tmp_path / "a.png").stat().st_size > 10_000
