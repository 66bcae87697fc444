"""Popping, exactly: what the order of Gaussians by their means changes, against the order on each pixel's ray.

    python -m benchmarks.accuracy.popping bonsai=OUT/bonsai lego=OUT/lego

The rasterizer blends Gaussians by the depths of their means. On a pixel's ray they are largest at other depths
(Radl et al. 2024, StopThePop). Random pixels of some views of each model are blended in float64 in both orders, with
EWA and with rays; nothing else differs. Counted are

- pixels whose order differs: of the Gaussians that a pixel blends, two or more are in the wrong order,
- the change of these pixels' colours, in steps of 8 bits: root of the mean square, 99 %, and the largest,
- jumps: the camera turns about its vertical axis, or moves towards the next view by 1e-4 extents. At the new place a
  pixel is blended in the new order and in the order before, so a jump is the part of a change that the order alone
  makes. Shown are the percentage of pixels that jump by half a step or more, and the largest jump, with the order of
  means and with the order on rays. A turn follows each pixel's ray, which meets the same Gaussians. A move cannot: the
  pixel gets another ray, which meets them in an order of its own. The order of means stays, as all depths change alike.
"""

import math
from collections import defaultdict
from typing import NamedTuple

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings
from torch import Tensor
from tqdm import tqdm

from benchmarks.accuracy.sampled_pixels import (
    Layers,
    SortedView,
    blended,
    depths_on_rays,
    layers,
    random_pixels,
    sorted_view,
)
from benchmarks.accuracy.trained_models import TrainedModel, model_parser, trained
from benchmarks.harness.measuring import chosen_device, describe, print_table
from utils.system_utils import run_cli

VIEWS, PIXELS = 8, 300  # of a model, and of a view
TURNS, STEP = (1e-4, 1.0), 1e-4  # degrees, extents
STEPS = 255  # of 8 bits
ORDERS = ("means", "rays")


class Popping(NamedTuple):
    """What was found at all pixels of a model, float64 (P,)."""

    differs: Tensor  # bool
    change: Tensor  # steps of 8 bits, largest of the colours, as is the next
    jumps: dict[tuple[str, str], Tensor]  # by motion and order


def extent_of(cameras: list[GaussianRasterizationSettings]) -> float:
    """1.1 times the largest distance of a camera from their middle, as trainings define it."""
    places = torch.stack([camera.campos for camera in cameras])
    return 1.1 * float((places - places.mean(0)).norm(dim=1).max())


def moved(camera: GaussianRasterizationSettings, degrees: float, step: Tensor) -> GaussianRasterizationSettings:
    """The camera turned about its vertical axis and moved by a step (3,) in the world."""
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    motion = torch.eye(4, dtype=torch.float64, device=step.device)
    motion[[0, 0, 2, 2], [0, 2, 0, 2]] = torch.tensor([cos, sin, -sin, cos], dtype=torch.float64, device=step.device)
    shift = torch.eye(4, dtype=torch.float64, device=step.device)
    shift[3, :3] = -step
    view = shift @ camera.viewmatrix @ motion
    projection = torch.linalg.inv(camera.viewmatrix) @ camera.projmatrix
    return camera._replace(viewmatrix=view, projmatrix=view @ projection, campos=camera.campos + step)


def same_rays(pixels: Tensor, before: GaussianRasterizationSettings, after: GaussianRasterizationSettings) -> Tensor:
    """Where a turned camera sees the rays of pixels (P, 2)."""
    size = torch.tensor([before.image_width, before.image_height], dtype=torch.float64, device=pixels.device)
    tangents = torch.tensor([before.tanfovx, before.tanfovy], dtype=torch.float64, device=pixels.device)
    principal = (torch.linalg.inv(before.viewmatrix) @ before.projmatrix)[2, :2]
    ray = ((2 * pixels + 1) / size - 1 - principal) * tangents
    ray = torch.cat([ray, torch.ones_like(ray[:, :1])], 1)
    ray = ray @ torch.linalg.inv(before.viewmatrix[:3, :3]) @ after.viewmatrix[:3, :3]
    return ((ray[:, :2] / ray[:, 2:] / tangents + principal + 1) * size - 1) / 2


def changes(first: Tensor, second: Tensor) -> Tensor:
    """Differences (P,) of colours (P, 3) as images show them, steps of 8 bits."""
    return STEPS * (first.clamp(0, 1) - second.clamp(0, 1)).abs().amax(1)


def is_inverted(found: Layers, used: Tensor) -> Tensor:
    """Whether of the layers that a pixel blends by the order of means, some are in another order on its ray: (P,)."""
    along = torch.where(used, found.along, -torch.inf)
    return (used & (along < along.cummax(1).values)).any(1)


def earlier_keys(now: SortedView, found: Layers, before: SortedView, pixels: Tensor, count: int) -> dict[str, Tensor]:
    """Depths (P, K) of a view's layers as they were in the view before, by order. count: the model's Gaussians."""
    place = torch.full((count,), -1, dtype=torch.int64, device=pixels.device)
    place[before.row] = torch.arange(len(before.row), device=pixels.device)
    which = place[now.row[found.which]]
    known = (which >= 0) & found.depth.isfinite()
    depths = before.depth[which], depths_on_rays(before, pixels, which)
    return {order: torch.where(known, depth, torch.inf) for order, depth in zip(ORDERS, depths, strict=True)}


def jumps_of(
    model: TrainedModel, before: SortedView, camera: GaussianRasterizationSettings, pixels: Tensor, followed: Tensor
) -> dict[str, Tensor]:
    """Jumps (P,) by order, from a view to another camera, where pixels (P, 2) are `followed` (P, 2)."""
    now = sorted_view(model.gaussians, camera, before.projection)
    found = layers(now, followed)
    old = earlier_keys(now, found, before, pixels, model.count)
    new = dict(zip(ORDERS, (found.depth, found.along), strict=True))
    return {
        order: changes(*(blended(found, now.background, keys[order])[0] for keys in (old, new))) for order in ORDERS
    }


def popping(model: TrainedModel, projection: str) -> Popping:
    """Measure a model's pixels."""
    differs, change, jumps = [], [], defaultdict(list)
    extent = extent_of(model.cameras)
    for place in tqdm(model.spread(VIEWS), desc=f"{model.label}, {projection}", unit="view", leave=False):
        camera = model.cameras[place]
        pixels = random_pixels(camera, PIXELS, seed=place)
        view = sorted_view(model.gaussians, camera, projection)
        found = layers(view, pixels)
        by_means, used = blended(found, view.background)
        differs.append(is_inverted(found, used))
        change.append(changes(by_means, blended(found, view.background, found.along)[0]))
        towards = model.cameras[(place + 1) % len(model.cameras)].campos - camera.campos
        towards = STEP * extent * towards / towards.norm()
        others = {f"turn of {degrees:g}°": moved(camera, degrees, 0 * towards) for degrees in TURNS}
        others["step"] = moved(camera, 0.0, towards)
        for motion, other in others.items():
            followed = pixels if motion == "step" else same_rays(pixels, camera, other)
            for order, jump in jumps_of(model, view, other, pixels, followed).items():
                jumps[motion, order].append(jump)
    return Popping(torch.cat(differs), torch.cat(change), {name: torch.cat(parts) for name, parts in jumps.items()})


def row(model: TrainedModel, projection: str, found: Popping) -> list[str]:
    """The table's row."""
    change = found.change
    rest = [float(change.square().mean().sqrt()), float(change.quantile(0.99)), float(change.max())]
    cells = [model.label, projection, f"{100 * float(found.differs.double().mean()):.1f}"]
    cells += [f"{value:.2f}" for value in rest]
    for jumps in found.jumps.values():
        cells.append(f"{100 * float((jumps >= 0.5).double().mean()):.2f}, {float(jumps.max()):.2g}")
    return cells


@torch.no_grad()
def main() -> None:
    args = model_parser(__doc__).parse_args()
    device = chosen_device(args)
    print(describe(device))
    rows = []
    for word in args.models:
        model = trained(word, device)
        for projection in ("ewa", "ray"):
            found = popping(model, projection)
            rows.append(row(model, projection, found))
    print(f"\n{VIEWS} views of each model, {PIXELS} random pixels of each; percent of pixels, steps of 8 bits\n")
    header = ["model", "projection", "order differs", "RMS", "99 %", "largest"]
    print_table([*header, *(f"{motion}, {order}" for motion, order in found.jumps)], rows)


if __name__ == "__main__":
    run_cli(main)
