"""The extensions: who may include what, the operators' schemas, and what the libraries take from torch."""

import importlib.util
import re
import shutil
import subprocess
from pathlib import Path

import diff_gaussian_rasterization  # noqa: F401  (loads the library with the operators)
import pytest
import torch

ROOT = Path(__file__).parents[1]
CSRC = sorted((ROOT / "submodules").glob("*/csrc"))
PACKAGES = ("diff_gaussian_rasterization", "fused_ssim", "simple_knn")
SUFFIXES = {".cpp", ".cu", ".cuh", ".h"}

SCENE = (
    "Tensor means, Tensor opacities, Tensor? scales, Tensor? rotations, Tensor? cov3d, Tensor? colors, Tensor? sh_dc, "
    "Tensor? sh_rest, Tensor view, Tensor projection, Tensor center, float tan_x, float tan_y, int height, int width, "
    "int sh_degree, float scale_modifier, bool antialiasing, bool raw"
)
BACKWARD = (
    "Tensor splats, Tensor instances, Tensor ranges, Tensor splat_slots, Tensor slots, Tensor background, Tensor last, "
    "Tensor transmittance, Tensor grad_color, Tensor? grad_transmittance, Tensor? grad_inverse_depth"
)
STEPPED_SCENE = (
    "Tensor(a!) means, Tensor(b!) opacities, Tensor(c!)? scales, Tensor(d!)? rotations, Tensor? cov3d, Tensor? colors, "
    "Tensor(e!)? sh_dc, Tensor(f!)? sh_rest" + SCENE[SCENE.index(", Tensor view") :]
)
GRADIENTS = (
    "(Tensor means, Tensor means2d, Tensor opacities, Tensor scales, Tensor rotations, Tensor cov3d, Tensor colors, "
    "Tensor sh_dc, Tensor sh_rest)"
)
STEP = (
    "Tensor radii, int[] attributes, Tensor(g!)[] exp_avg, Tensor(h!)[] exp_avg_sq, Tensor(i!)[] steps, float[] rates, "
    "float beta1, float beta2, float eps, int[] columns, bool sparse, Tensor(j!)? max_radii=None, "
    "Tensor(k!)? gradient_sums=None, Tensor(l!)? views=None, Tensor? loss=None, Tensor(m!)? stopped=None, "
    "int iteration=0, Tensor? now=None, bool absolute=False, float opacity_penalty=0., float scale_penalty=0."
)
ROWS = "Tensor splats, Tensor tile_counts, Tensor rows, Tensor counts"
SCHEMAS = [
    f"project({SCENE}) -> (Tensor splats, Tensor depths, Tensor rects, Tensor tile_counts, Tensor radii)",
    "bin(Tensor splats, Tensor depths, Tensor rects, Tensor tile_counts, int height, int width, bool train) -> "
    "(Tensor instances, Tensor ranges, Tensor splat_slots, Tensor slots)",
    "blend(Tensor splats, Tensor instances, Tensor ranges, Tensor background, int height, int width, "
    "bool inverse_depth, bool train) -> (Tensor color, Tensor transmittance, Tensor inverse_depth, Tensor last, "
    "Tensor layers)",
    f"blend_vjp({BACKWARD}) -> Tensor moments",
    f"project_vjp({SCENE}, Tensor tile_counts, Tensor moments, bool[9] wanted) -> {GRADIENTS}",
    f"rasterize(Tensor means2d, {SCENE}, Tensor background, bool inverse_depth, bool train, bool absolute=False) -> "
    "(Tensor color, Tensor transmittance, Tensor inverse_depth, Tensor radii, Tensor splats, Tensor tile_counts, "
    "Tensor instances, Tensor ranges, Tensor splat_slots, Tensor slots, Tensor last, Tensor layers)",
    f"rasterize_vjp({SCENE}, {BACKWARD}, Tensor tile_counts, Tensor layers, bool[9] wanted, bool absolute=False) -> "
    f"{GRADIENTS}",
    f"blend_rows({BACKWARD}, Tensor layers, bool absolute=False) -> (Tensor rows, Tensor counts)",
    f"rows_vjp({SCENE}, {ROWS}, bool[9] wanted, bool absolute=False) -> {GRADIENTS}",
    f"rows_vjp_add_({SCENE}, {ROWS}, Tensor(a!)[] sums, bool absolute=False) -> ()",
    "pack_splats_(Tensor(a!) packed, Tensor splats, Tensor depths, Tensor rects, Tensor tile_counts, Tensor gaussians) "
    "-> ()",
    "unpack_splats(Tensor packed, Tensor like) -> (Tensor splats, Tensor depths, Tensor rects, Tensor tile_counts)",
    "count_records(Tensor rects, Tensor tile_counts, Tensor limits) -> Tensor",
    "list_records(Tensor rects, Tensor tile_counts, Tensor limits, Tensor counts, int room) -> "
    "(Tensor gaussians, Tensor places)",
    "sum_runs(Tensor rows, Tensor counts, Tensor kept, int room) -> Tensor",
    "sum_parts(Tensor counts, int[] sizes) -> Tensor",
    "move_runs(Tensor rows, Tensor counts, Tensor places) -> Tensor",
    f"rasterize_vjp_step_({STEPPED_SCENE}, {BACKWARD}, Tensor tile_counts, Tensor layers, {STEP}) -> ()",
    f"rows_vjp_step_({STEPPED_SCENE}, {ROWS}, {STEP}) -> ()",
    "step_now_(Tensor(a!) now, int[] attributes, Tensor(b!)[] steps, float[] rates, float beta1, float beta2, "
    "float eps, bool sparse, int iteration) -> ()",
    "mark_visible(Tensor means, Tensor view) -> Tensor",
    "decisive(Tensor splats, Tensor instances, Tensor ranges, Tensor last) -> Tensor",
    "adam_(Tensor(a!)[] values, Tensor[] gradients, Tensor(b!)[] exp_avg, Tensor(c!)[] exp_avg_sq, Tensor(d!)[] steps, "
    "float[] rates, float beta1, float beta2, float eps, int[] columns, Tensor? loss=None, Tensor(e!)? stopped=None, "
    "int iteration=0) -> ()",
    "sparse_adam_(Tensor(a!) value, Tensor gradient, Tensor(b!) exp_avg, Tensor(c!) exp_avg_sq, Tensor visible, "
    "float lr, float beta1, float beta2, float eps, int columns=-1, Tensor? loss=None, Tensor(d!)? stopped=None, "
    "int iteration=0) -> ()",
    "catch_up_(Tensor(a!) value, Tensor(b!) exp_avg, Tensor(c!) exp_avg_sq, Tensor taken, float[] rates, "
    "float[] steps, float beta1, float beta2, float eps, int columns=-1) -> ()",
    "in_host_memory(Tensor values) -> Tensor",
    "is_in_host_memory(Tensor values) -> bool",
    "observe_(Tensor(a!) max_radii, Tensor(b!) gradient_sums, Tensor(c!) views, Tensor radii, Tensor gradient) -> ()",
    "split_positions(Tensor means, Tensor log_scales, Tensor rotations, Tensor items, int seed, int stream, "
    "int iteration, int draw) -> Tensor",
    "add_noise_(Tensor(a!) means, Tensor log_scales, Tensor rotations, Tensor logits, float size, float steepness, "
    "float threshold, int seed, int stream, int iteration, Tensor? stopped=None, int first=0) -> ()",
    "penalise_(Tensor logits, Tensor log_scales, Tensor(a!) logit_gradients, Tensor(b!) log_scale_gradients, "
    "float opacity, float scale) -> ()",
]


def includes(folder: Path) -> list[tuple[Path, str]]:
    files = [path for path in sorted(folder.rglob("*")) if path.suffix in SUFFIXES]
    return [(path, name) for path in files for name in re.findall(r'^#include [<"](.*?)[>"]', path.read_text(), re.M)]


@pytest.mark.parametrize("schema", SCHEMAS, ids=[schema.partition("(")[0] for schema in SCHEMAS])
def test_schemas(schema):
    packet = getattr(torch.ops.diff_gaussian_rasterization, schema.partition("(")[0])
    assert str(packet.default._schema) == f"diff_gaussian_rasterization::{schema}"


@pytest.mark.parametrize("csrc", CSRC, ids=[csrc.parent.name for csrc in CSRC])
def test_only_the_torch_folder_sees_torch(csrc):
    seeing = {path for path, name in includes(csrc) if re.match(r"(torch|ATen|c10)/|gs/torch_", name)}
    assert seeing and {path.parent.name for path in seeing} == {"torch"}


@pytest.mark.parametrize("csrc", CSRC, ids=[csrc.parent.name for csrc in CSRC])
def test_math_stands_below_everything(csrc):
    headers = {path.name for path in (csrc / "math").iterdir()}
    for path, name in includes(csrc / "math"):
        assert name in headers or name == "../data.h" or re.fullmatch(r"gs/\w+\.h|c\w+|limits|algorithm", name), path


@pytest.mark.skipif(shutil.which("nm") is None, reason="needs nm of the binary utilities")
@pytest.mark.parametrize("package", PACKAGES)
def test_a_library_uses_torch_through_its_stable_interface_alone(package):
    library = Path(importlib.util.find_spec(package).origin).with_name("_backend.so")
    symbols = subprocess.run(["nm", "-D", str(library)], capture_output=True, text=True, check=True).stdout
    names = [line.split()[-1].partition("@")[0] for line in symbols.splitlines()]
    assert "torch_library_impl" in names
    forbidden = re.compile(r"_Z.*N[VK]*(3c10|2at|5torch|8pybind11)\d|_?Py[A-Z_]")
    assert [name for name in names if forbidden.match(name)] == []
