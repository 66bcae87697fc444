"""Benchmarks: counts against plain loops, short names of kernels, `-h` of every command."""

import ast
import importlib
import math
import sys
from pathlib import Path

import diff_gaussian_rasterization
import pytest

from benchmarks import scaling_model
from benchmarks.harness.calls import Stages
from benchmarks.harness.page import replace_tables
from benchmarks.harness.timing import short_name
from benchmarks.kernels import builds
from benchmarks.kernels.fragments import TILE, fragments, processed_per_tile
from benchmarks.kernels.host_ops import NODE, calls_per_iteration, operator_calls
from benchmarks.kernels.seen_share import SHARES, Ring, measure
from benchmarks.scenes import step_profile
from benchmarks.workloads.splat_scenes import frustum

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
MODULES = sorted(path for path in BENCHMARKS.glob("*/*.py") if path.name != "__init__.py")
COMMANDS = [path for path in MODULES if '__name__ == "__main__"' in path.read_text()]


def _name(path: Path) -> str:
    return f"benchmarks.{path.parent.name}.{path.stem}"


def test_fragments_are_those_of_a_loop_over_pixels():
    scene = frustum(150, 40, 27, 4.0, seed=3)
    stages = Stages(scene)
    rows, instances, last = stages.splats.double().tolist(), stages.instances.tolist(), stages.last
    blended, pixels, across = 0, scene.width * scene.height, -(-scene.width // TILE)
    for y in range(scene.height):
        for x in range(scene.width):
            begin = int(stages.ranges[y // TILE * across + x // TILE])
            for index in instances[begin : begin + int(last[y, x])]:
                mean_x, mean_y, l11, l12, l22, log2_opacity = rows[index][:6]
                u, v = l11 * (x - mean_x) + l12 * (y - mean_y), l22 * (y - mean_y)
                blended += log2_opacity - u * u - v * v >= -math.log2(255)
    counted = fragments(stages.splats, stages.instances, stages.ranges, last)
    assert counted["blended"] == blended / pixels > 5
    assert counted["blended"] < counted["8x4"] < counted["8x8"] < counted["16x8"] < counted["16x16"]
    # Instances are exact, so each one reaches its tile.
    assert counted["16x16"] == int(processed_per_tile(last).sum()) * TILE * TILE / pixels


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


def test_an_iteration_makes_few_calls(colmap_scene):
    """Each call slows a step that is bound by the host, so this test must notice added calls."""
    calls = calls_per_iteration("-s", str(colmap_scene), "-r", "24")
    for op in ("rasterize", "rasterize_vjp_step_"):
        assert calls[f"diff_gaussian_rasterization::{op}"] == 1, op
    assert calls["fused_ssim::photometric"] == calls["fused_ssim::photometric_vjp"] == 1
    assert calls[NODE] <= 2  # the loss, and the image that it is differentiated by
    assert operator_calls(calls) <= 70  # and some 20 for the order of the views, drawn once an epoch of 17


@pytest.mark.parametrize("share", SHARES)
def test_views_of_the_ring_see_the_share_that_was_asked_for(share):
    ring = Ring(20_000, 400, 265, "cpu")
    assert ring.seen(ring.views(share, 5)) == pytest.approx(share, rel=0.15, abs=0.015)


def test_a_row_for_each_share():
    rows = measure("cpu", (300, 40, 27), 2)
    assert [len(row) for row in rows] == [2] * len(SHARES)
    assert all(float(row[1]) > 0 for row in rows)


@pytest.mark.parametrize("path", COMMANDS, ids=_name)
def test_every_command_answers_h(path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [path.name, "-h"])
    with pytest.raises(SystemExit) as stopped:
        importlib.import_module(_name(path)).main()
    assert stopped.value.code == 0
    assert capsys.readouterr().out.startswith(f"usage: {path.name} [-h]")


@pytest.mark.parametrize("path", COMMANDS, ids=_name)
def test_every_command_shows_how_it_is_run(path):
    assert f"python -m {_name(path).removesuffix('.__main__')} " in ast.get_docstring(ast.parse(path.read_text()))


def test_the_profile_of_a_step_adds_up_kernels_by_name():
    kernels = {
        "void gs::cuda::(anonymous namespace)::blend_kernel<true>(int const*, gs::BlendInput<float>)": 3.0,
        "void gs::cuda::(anonymous namespace)::blend_kernel<false>(int const*, gs::BlendInput<float>)": 2.0,
        "void at::native::vectorized_elementwise_kernel<4, at::native::FillFunctor<float>>(int)": 1.0,
        "Memcpy HtoD (Pinned -> Device)": 4.0,
    }
    run = {"kernels": kernels, "counts": dict.fromkeys(kernels, 1.5)}
    sums = step_profile._by_name(run)
    assert sums["blend_kernel"] == (5.0, 3.0) and sums["vectorized_elementwise_kernel"] == (1.0, 1.5)
    assert step_profile._kernels(run) == 6.0  # a copy from the host runs beside the kernels


def test_the_page_on_scaling_has_the_tables_of_the_model():
    page = (BENCHMARKS.parent / "docs" / "inside" / "scaling.md").read_text(encoding="utf-8")
    for name, lines in scaling_model.tables().items():
        assert f"<!-- begin {name} -->" in page
        assert replace_tables(page, name, lines) == page, name


def test_the_model_of_scaling_sends_the_bytes_of_the_code():
    projected = Stages(frustum(9, 40, 27, 4.0)).calls["project"]()
    sizes = [tensor[:1].nbytes for tensor in projected]
    assert sum(sizes[:4]) == scaling_model.RECORD
    assert sum(sizes) == scaling_model.PROJECTED


def test_the_model_of_scaling_agrees_with_stages_that_were_measured():
    """M+, L and XL of docs/results/kernels.md: project, bin, blend, blend_vjp."""
    measured = {
        (1e6, 4.41e6, 1.68e6): (0.112, 0.270, 0.295, 0.665),
        (3e6, 10.03e6, 2.22e6): (0.287, 0.569, 0.346, 0.816),
        (6e6, 17.25e6, 2.69e6): (0.544, 0.985, 0.388, 0.953),
    }
    for (n, instances, processed), wanted in measured.items():
        parts = scaling_model.stages(n, n, n, instances, processed, 1600 * 1060)
        got = [parts[name] for name in ("project", "bin", "blend", "blend_vjp")]
        assert got == pytest.approx(wanted, rel=0.02)


def test_two_ranks_send_each_other_half_of_what_a_view_sees():
    scene = scaling_model.Workload("", 100, 80, 200, 90, 60, 32, 64, rows=1.0)
    sent = scaling_model.tiles_traffic(scene, 2)
    photo = 3 * 32 * 64 / 2
    assert sent == {"records": 64 * 20, "image": 2 * 10 * 32 * 12, "rows": 40 * 15, "counts": 4 * 20, "photo": photo}
    whole = scaling_model.tiles_traffic(scene, 2, scaling_model.WHOLE_IMAGE)
    assert whole == sent | {"image": 12 * 32 * 64 / 2}
    assert scaling_model.tiles_traffic(scene, 1) == dict.fromkeys(sent, 0)


def test_two_builds_take_turns(monkeypatch, capsys):
    folder = str(Path(diff_gaussian_rasterization.__file__).parents[1])
    words = ["builds", folder, folder, "--device", "cpu", "--workloads", "S", "--starts", "1", "--rounds", "1"]
    monkeypatch.setattr(sys, "argv", words)
    builds.main()
    rows = [line.split("|")[1:-1] for line in capsys.readouterr().out.splitlines() if line.startswith("| S ")]
    assert [row[1].strip() for row in rows] == list(builds.STEPS)
    assert all(0.2 < float(row[4]) < 5 and float(row[2]) > 0.05 for row in rows)
