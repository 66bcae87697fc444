"""A view by several processes: the image and all gradients of one process, to the bit."""

import gc
import time
import weakref
from collections.abc import Callable
from typing import Any

import torch
from diff_gaussian_rasterization import rasterize
from diff_gaussian_rasterization.scene import draw
from processes import in_ranks
from rasterizer_tools import leaves, ops, scene_arguments
from torch import Tensor

from gaussian_renderer.over_ranks.band import decisive_in, draw_view
from gaussian_renderer.over_ranks.rasterize import rasterize_over
from groundwork.ranks.ranks import ranks
from tests.workloads.splat_scenes import settings

CAMERA = "viewmatrix", "campos"
# Width, height, and what differs from an ordinary call.
CASES = [
    (80, 150, {}),
    (33, 20, {"want_inverse_depth": True}),  # fewer rows of tiles than ranks
    (16, 16, {"want_inverse_depth": True}),  # one tile
    (40, 70, {"want_absolute_gradient": True}),
    (120, 33, {"kind": "near"}),
    (50, 90, {"count": 2}),  # fewer Gaussians than ranks
    (20, 40, {"count": 0}),
    (64, 64, {"behind": True}),  # nothing is seen
]


def _scene(width: int, height: int, options: dict) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(width)
    count = options.get("count", 300)
    depth = 1.5 + 3 * torch.rand(count, 1, generator=generator)
    across = torch.rand(count, 2, generator=generator) - 0.5
    size = 0.6 if options.get("kind") == "near" else 0.12
    parameters = {
        "means": torch.cat([1.2 * across * depth, -depth if options.get("behind") else depth], 1),
        "opacities": torch.randn(count, 1, generator=generator),
        "scales": torch.randn(count, 3, generator=generator) * 0.8 + torch.tensor(size).log(),
        "rotations": torch.randn(count, 4, generator=generator),
        "sh_dc": torch.randn(count, 1, 3, generator=generator),
        "sh_rest": 0.2 * torch.randn(count, 15, 3, generator=generator),
    }
    return {name: values.float() for name, values in parameters.items()}


def _render(function, width: int, height: int, options: dict, rows: slice) -> dict[str, Tensor]:
    """Image, radii and gradients of the Gaussians `rows`."""
    wanted = {name: value for name, value in options.items() if name.startswith("want")}
    inputs = leaves({name: values[rows] for name, values in _scene(width, height, options).items()})
    screen = torch.zeros_like(inputs["means"]).requires_grad_()
    rest = dict(inputs)
    camera = settings(width, height, torch.float32)
    camera = camera._replace(**{name: getattr(camera, name).clone().requires_grad_() for name in CAMERA})
    out = function(rest.pop("means"), screen, rest.pop("opacities"), settings=camera, raw=True, **rest, **wanted)
    generator = torch.Generator().manual_seed(5)
    loss = (torch.randn(out.color.shape, generator=generator) * out.color).sum()
    if out.inverse_depth is not None:
        loss = loss + (torch.randn(out.inverse_depth.shape, generator=generator) * out.inverse_depth).sum()
    loss.backward()
    gradients = {f"d {name}": values.grad for name, values in inputs.items()} | {"d means2d": screen.grad}
    gradients |= {name: getattr(camera, name).grad for name in CAMERA}
    planes = {"color": out.color.detach()}
    if out.inverse_depth is not None:
        planes["inverse_depth"] = out.inverse_depth.detach()
    return {**planes, "radii": out.radii, **gradients}


def _render_shards() -> list[dict[str, Tensor]]:
    here, results = ranks(), []
    for width, height, options in CASES:
        count = options.get("count", 300)
        # Shards of different lengths, the first of which is short.
        cuts = [0, *[(count * (r * r)) // (here.size * here.size) for r in range(1, here.size)], count]
        rows = slice(cuts[here.rank], cuts[here.rank + 1])
        results.append(_render(lambda *x, **y: rasterize_over(here, *x, **y), width, height, options, rows))
    return results


def test_ranks_render_the_image_and_the_gradients_of_one_process():
    found = in_ranks(3, _render_shards)
    for number, (width, height, options) in enumerate(CASES):
        alone = _render(rasterize, width, height, options, slice(None))
        for name, values in alone.items():
            parts = [of_rank[number][name] for of_rank in found]
            for whole in parts if name in ("color", "inverse_depth", *CAMERA) else [torch.cat(parts)]:
                if name in CAMERA:  # the shards are no whole blocks of rows
                    torch.testing.assert_close(whole, values, rtol=1e-5, atol=1e-5)
                else:
                    assert torch.equal(whole, values), (number, name)
        seen = (alone["radii"] > 0).any()
        assert seen == (options.get("count", 300) > 0 and not options.get("behind"))


def _decisive() -> list[Tensor]:
    """Return which of this rank's Gaussians are decisive, by case."""
    here, found = ranks(), []
    for width, height, options in CASES:
        parameters, count = _scene(width, height, options), options.get("count", 300)
        rows = slice(*(count * r // here.size for r in (here.rank, here.rank + 1)))
        own = scene_arguments({name: t[rows] for name, t in parameters.items()}, settings(width, height, torch.float32))
        found.append(decisive_in(draw_view(here, own, torch.zeros(3), False, train=True)))
    return found


def test_ranks_find_the_decisive_gaussians_of_one_process():
    every, shares = in_ranks(3, _decisive), []
    for number, (width, height, options) in enumerate(CASES):
        scene = scene_arguments(_scene(width, height, options), settings(width, height, torch.float32))
        drawn = draw(scene, torch.zeros(3))
        alone = ops.decisive(drawn.splats, drawn.instances, drawn.ranges, drawn.last)
        assert torch.equal(torch.cat([of_rank[number] for of_rank in every]), alone)
        shares.append(alone.float().mean())
    assert any(0.1 < share < 0.9 for share in shares)


def _tensors_left() -> dict[str, int]:
    """Tensors that a view leaves behind, once nothing refers to its results."""
    width, height, options = CASES[1]
    renders = {
        "one process": lambda: _render(rasterize, width, height, options, slice(None)),
        "a view": lambda: _render(
            lambda *x, **y: rasterize_over(ranks(), *x, **y), width, height, options, slice(None)
        ),
    }
    return {name: _left_by(render) for name, render in renders.items()}


def _left_by(render: Callable[[], Any]) -> int:
    render()  # may fill caches
    before = _tensors()
    render()
    known = set(map(id, before))
    new = [weakref.ref(each) for each in _tensors() if id(each) not in known]
    # A thread of gloo may hold what was sent for a moment after the call has returned.
    end = time.monotonic() + 10
    while any(each() is not None for each in new) and time.monotonic() < end:
        time.sleep(0.01)
    return sum(each() is not None for each in new)


def _tensors() -> list[Tensor]:
    gc.collect()
    return [each for each in gc.get_objects() if type(each) is Tensor]


def test_a_view_over_ranks_leaves_nothing_behind():
    for left in in_ranks(2, _tensors_left):
        assert left == dict.fromkeys(left, 0)
