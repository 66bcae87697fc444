"""Features that are off: calls allocate nothing for them, and opaque tiles end early."""

import math

import torch
from gaussians import options, pipeline
from rasterizer_tools import CPU_AND_GPU, ops
from torch.profiler import ProfilerActivity, profile

from gaussian_renderer import render
from scene.cameras import MiniCam
from scene.gaussian_model import GaussianModel
from tests.workloads.splat_scenes import frustum, model_rows

SPLATS, WIDTH, HEIGHT = 500, 70, 50


def _bytes(run) -> int:
    """Bytes that a call takes from the CPU's allocator, whether or not it gives them back."""
    run()
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as trace:
        run()
    events = trace.profiler.kineto_results.events()
    return sum(max(event.nbytes(), 0) for event in events if event.name() == "[memory]")


def _model(degree: int = 3) -> tuple[GaussianModel, MiniCam]:
    scene = frustum(SPLATS, WIDTH, HEIGHT, 2.0)
    rows = model_rows(scene.parameters)
    rows["f_rest"] = rows["f_rest"][:, : (degree + 1) ** 2 - 1].contiguous()
    model, s = GaussianModel(degree), scene.settings(torch.float32)
    model.set_rows(rows)
    model.active_sh_degree = 0
    model.training_setup(options())
    model.limit_columns()  # as train.py does
    fov = [2 * math.atan(t) for t in (s.tanfovy, s.tanfovx)]
    return model, MiniCam(WIDTH, HEIGHT, *fov, 0.01, 100.0, s.viewmatrix, s.projmatrix)


def test_a_render_allocates_outputs_on_request_only():
    model, camera = _model()

    @torch.no_grad()
    def image(**wanted):
        return render(camera, model, pipeline(), torch.zeros(3), want_visibility=False, **wanted)["render"]

    without = _bytes(lambda: image(want_depth=False))
    assert _bytes(lambda: image(want_depth=True)) - without == 4 * WIDTH * HEIGHT
    # Without gradients no slots of splats and no last splat of each pixel are kept.
    with torch.enable_grad():
        assert _bytes(lambda: render(camera, model, pipeline(), torch.zeros(3), want_depth=False)["render"]) > without


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
