"""Benchmarks: every command on a tiny case, and what their tables and figures make of numbers."""

import json
import re
import sys
from collections import Counter
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import stand_ins
import torch
from pycolmap import Reconstruction
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile

import full_eval
import train
from benchmarks.accuracy import oracle
from benchmarks.accuracy.runs import CPU_DOUBLE, CPU_FLOAT, CUDA_FLOAT
from benchmarks.harness.calls import by_stage
from benchmarks.harness.measuring import GpuTime, short_name
from benchmarks.kernels import rasterizer
from benchmarks.parallel import kernels as kernels_of_steps
from benchmarks.parallel import steps, workload
from benchmarks.scenes import made, scores
from benchmarks.scenes.thinned import thinned
from scene.dataset_readers import read_scene
from scene.point_depths import HELD_OUT
from splatting.demo.tracer import ring_views, trace
from splatting.evaluation.configs import read_configs
from splatting.files.image_files import write_plane
from utils.system_utils import UserError


def test_no_command_imports_the_benchmarks():
    """They measure the project, which must run without them; of its rooms, test_house.py says so."""
    commands = Path(__file__).parents[1].glob("*.py")
    assert not [
        path for path in commands if re.search(r"^\s*(from|import) benchmarks\b", path.read_text(), re.MULTILINE)
    ]


@pytest.mark.parametrize(
    ("name", "short"),
    [
        ("void gs::cuda::(anonymous namespace)::blend_kernel<false, true>(gs::Input<float>, int)", "blend_kernel"),
        ("void cub::X_900::detail::SortKernel<cub::P<(int)3, float>, (cub::Y)0>(unsigned int*)", "SortKernel"),
        ("Memcpy DtoH (Device -> Pageable)", "Memcpy DtoH"),
        ("Memset (Device)", "Memset"),
    ],
)
def test_short_names(name, short):
    assert short_name(name) == short


def test_kernels_belong_to_the_stage_that_began():
    names = ["fill", "project_kernel", "sort", "blend_kernel", "l1_ssim_kernel", "l1_ssim_vjp_kernel", "mark"]
    stages = [stage for stage, _, _ in by_stage([(name, 1.0) for name in [*names, "project_vjp_kernel"]])]
    assert stages == ["project", "project", "bin", "blend", "loss", "loss", "blend_vjp", "step"]


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


def test_a_thinned_scene_trains_on_every_third_photo(colmap_scene, tmp_path):
    whole = read_scene(colmap_scene, "images", hold_out=True)
    few = read_scene(thinned(colmap_scene, tmp_path / "few", 3), "images", hold_out=True)
    by_name = lambda views: sorted(views, key=lambda view: view.image_name)  # noqa: E731
    for found, given in (
        (few.train_cameras, by_name(whole.train_cameras)[::3]),
        (few.test_cameras, by_name(whole.test_cameras)[:1]),
    ):
        assert [Path(view.image_path).resolve() for view in by_name(found)] == [
            Path(view.image_path).resolve() for view in given
        ]
    points = (tmp_path / "few/sparse/0/points3D.txt").read_text().splitlines()
    known = Reconstruction(str(colmap_scene / "sparse/0")).num_points3D()
    assert len(points) == known - -(-known // HELD_OUT)


def test_models_are_scored_again_with_other_options_of_render(tmp_path, monkeypatch, capsys):
    scene, out = tmp_path / "attic", tmp_path / "out"
    (scene / "sparse").mkdir(parents=True)
    sets = tmp_path / "sets.json"
    sets.write_text('{"none": [], "deep": ["--sparse_depth", "0.5"]}')
    words = f"--scenes {scene} --output_path {out} --iterations 40 --seeds 0 1 --configs {sets}"
    monkeypatch.setattr(full_eval, "facts_asked", dict)
    full_eval.main(words.split(), stand_ins.run)
    monkeypatch.setattr(scores, "run_child", stand_ins.run)
    capsys.readouterr()
    monkeypatch.setattr(sys, "argv", f"scores {out} -- --depth -r 34".split())
    scores.main()
    calls = [json.loads(line) for line in (tmp_path / "calls.txt").read_text().splitlines()]
    assert [words[-3:] for words in calls if words[0] == "render"][4:] == [["--depth", "-r", "34"]] * 4
    none, deep = _rows(capsys.readouterr().out, "attic")
    assert (none[1:3], none[-1]) == (["none", "23.05"], "+0.00 (0.00)")
    assert (deep[1:3], deep[-1]) == (["deep", "23.80"], "+0.75 (0.35)")  # the stand-in adds more to the second seed
    monkeypatch.setattr(sys, "argv", ["scores", str(tmp_path)])
    with pytest.raises(UserError, match="has no report of full_eval.py"):
        scores.main()


@pytest.mark.parametrize("path", sorted((Path(__file__).parents[1] / "benchmarks/sets").glob("*.json")), ids=str)
def test_sets_are_options_of_training(path):
    assert read_configs(path, train.parse)


def test_floaters_are_counted_where_nothing_was_traced(tmp_path, monkeypatch):
    """Half transparent planes: a quarter of the columns nearer than a quarter of the extent, all else beyond all."""
    monkeypatch.setattr(made, "_SIZE", (32, 24))
    monkeypatch.setattr(scores, "read_scene", lambda *_, **__: SimpleNamespace(extent=4.0))
    inverse, sky = np.full((24, 32), 0.5 / 100), []
    inverse[:, :8] = 0.5 / 0.9
    for place, view in enumerate(ring_views(48, 32, 24, np.random.default_rng(0))[::8]):
        for plane, values in (("depth", inverse), ("alpha", np.full((24, 32), 0.5))):
            (tmp_path / plane).mkdir(exist_ok=True)
            write_plane(tmp_path / plane / f"{place:05d}.png", values)
        rows, columns = np.indices((24, 32)) + 0.5
        rays = view.rays(columns.ravel(), rows.ravel())
        sky.append(np.isinf(trace(made.with_sky(None), np.float32(view.center)[:, None], rays)[0]).reshape(24, 32))
    found = scores.floaters("sky", tmp_path, tmp_path)
    assert found["NEAR"] == 0.25 and found["SKY"] == pytest.approx(np.mean(sky, (0, 1))[:8].sum() / np.mean(sky) / 32)
    assert 0 < found["SKY"] < 1 and scores.floaters("clean", tmp_path, tmp_path) == {"NEAR": 0.25}


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


def test_tables_of_a_gpu_have_stages_memory_and_others(monkeypatch, capsys):
    launched = [("project_kernel", 0.25), ("sort", 0.5), ("blend_kernel", 1.0), ("blend_kernel", 0.125)]
    times = dict.fromkeys(("forward", "+ backward", "step"), GpuTime(0.82, launched))
    monkeypatch.setattr(rasterizer, "measure_on_gpu", lambda name, _: rasterizer.Measured(name, times, [20.0, 70.0]))
    rasterizer.print_gpu((name, None) for name in ("S", "M", "lego"))
    said = capsys.readouterr().out
    assert ["blend", *["1.125"] * 3] in _rows(said, "blend ") and ["bin", *["0.500"] * 3] in _rows(said, "bin ")
    assert ["lego", "forward", "0.820", "1.875", "", "", ""] in _rows(said, "lego ")
    assert _rows(said, "S ") == [
        ["S", "20", "29", "50", "70", "133", "54"],
        ["S", "forward", "0.820", "1.875", "0.41", "1.11", "2.00"],
        ["S", "+ backward", "0.820", "1.875", "1.16", "2.47", "0.71"],
        ["S", "step", "0.820", "1.875", "1.21", "2.95", "0.68"],
    ]


@pytest.mark.parametrize("name", ["XL", "city"])
def test_ranks_draw_together_what_one_process_draws(name, monkeypatch):
    monkeypatch.setattr(workload, "_PIECE", 300)
    scene = workload.ALL[name].changed(1000, (64, 40))
    cpu = torch.device("cpu")
    whole = scene.rows(0, 1, cpu, cpu)
    parts = [scene.rows(rank, 3, cpu, cpu) for rank in range(3)]
    for attribute, values in whole.items():
        assert len(values) == 1000 and torch.equal(torch.cat([part[attribute] for part in parts]), values)


@pytest.mark.slow
def test_steps_of_ranks_and_of_a_spilled_model_stand_beside_those_of_one_process(monkeypatch, capsys):
    words = "--size 64 40 --rounds 1 --warm_up 2 --blocks 2 --workload city --gaussians 1000 --crop 2"
    launch = steps.launch  # one rank needs no process of its own
    here = lambda case, limit: steps.measure(case) if case["ranks"] == 1 else launch(case, limit)  # noqa: E731
    monkeypatch.setattr(steps, "launch", here)
    monkeypatch.setattr(sys, "argv", ["steps", "--ranks", "1", "2", "--kernels", *words.split()])
    steps.main()
    said = capsys.readouterr().out
    rows = _rows(said, "city")
    assert [row[0] for row in _rows(said, "")[-3:]] == ["all kernels", "messages", "packing"]
    assert [row[1:3] for row in rows] == [["1", "gpu"], ["2", "gpu"]]
    assert rows[0][6] == "1.00" and float(rows[1][6]) > 0
    monkeypatch.setattr(
        sys, "argv", ["steps", "--model", "sleep", "spill", "--learn", "--cap", "0.001", *words.split()]
    )
    steps.main()
    rows = _rows(capsys.readouterr().out, "city")
    assert rows[0][-1] == rows[1][-1] != ""


def test_kernels_are_messages_or_pack_them_or_neither():
    def launched(name: str, us: float) -> tuple[SimpleNamespace, SimpleNamespace]:
        span = SimpleNamespace(elapsed_us=lambda: us)
        on_device = SimpleNamespace(name=name, device_type=DeviceType.CUDA, time_range=span)
        return on_device, SimpleNamespace(name=name, duration=us)

    kernels = [
        launched("void gs::list<5>(int)", 4000),
        launched("ncclDevKernel_SendRecv(x)", 2000),
        launched("a", 1000),
    ]
    inner = SimpleNamespace(name="op", device_type=DeviceType.CPU, kernels=[k[1] for k in kernels[:2]], cpu_children=[])
    scope = SimpleNamespace(name="send_splats", device_type=DeviceType.CPU, kernels=[], cpu_children=[inner])
    spans = [launched("send_splats", 9000)[0], launched("nccl:all_to_all", 9000)[0]]
    found = kernels_of_steps.sums_of([*(k[0] for k in kernels), inner, scope, *spans], 2)
    names = {"list": 2.0, "ncclDevKernel_SendRecv": 1.0, "a": 0.5}
    assert found == {"all kernels": 3.5, "messages": 1.0, "packing": 2.0, **names}
    assert kernels_of_steps.kernel_rows([{"all kernels": 2.0, "messages": 0.0, "packing": 0.0, "a": 1.5}, found]) == [
        ["all kernels", "2.000", "3.500"],
        ["messages", "0.000", "1.000"],
        ["packing", "0.000", "2.000"],
        ["list", "", "2.000"],
        ["a", "1.500", "0.500"],
        ["ncclDevKernel_SendRecv", "", "1.000"],
    ]


def test_bytes_of_a_gaussian_are_those_of_a_line():
    def found(millions: int, mib: float) -> dict:
        own = {"ms": [1.0], "peak": mib, "last": 2 * mib, "digest": "", "memory": 2**40, "far": 0.0}
        case = {"workload": "city", "ranks": 1, "model": "gpu", "learn": False}
        return case | {"name": "", "gaussians": millions * 2**20, "by_rank": [own]}

    said = steps.bytes_each([found(1, 1000), found(3, 2000), found(2, 9999)])
    assert said[0].startswith("city, 1 ranks, gpu: 500 bytes a Gaussian before the last step, so 2")
    assert said[1].startswith("city, 1 ranks, gpu: 1000 bytes a Gaussian in the last step, so 1")


def test_error_is_of_the_largest_reference_value():
    assert oracle.error(*torch.tensor([[1.0, 2.5, -4.0], [1.0, 2.0, -5.0]]).double()) == (0.2, 0.1)


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
