"""A scene whose views see a part of it: clusters of Gaussians in a ring, and cameras that see a wanted share."""

import math

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings
from torch import Tensor

from benchmarks.workloads.splat_scenes import FOV, Draw, SplatScene, on_device, settings

RADIUS = 10.0
CLUSTERS = 60
SIGMA_PX = 1.4  # median size from the ring's middle
_FARTHEST = 4 * RADIUS  # from where a view has the whole ring in front of it
_STEPS = 40  # of the bisection


def ring_of_clusters(n: int, width: int, height: int, seed: int = 0, device: torch.device | str = "cpu") -> SplatScene:
    """Draw Gaussians in clusters that stand in a ring around the origin, in the plane of x and z; rows at random."""
    draw = Draw(seed, device)
    cluster = (CLUSTERS * draw.uniform(n)).long().clamp_max(CLUSTERS - 1)
    angles = 2 * math.pi * (torch.arange(CLUSTERS, device=device) + draw.uniform(CLUSTERS)) / CLUSTERS
    centers = torch.stack([RADIUS * angles.sin(), 4 * draw.uniform(CLUSTERS) - 2, RADIUS * angles.cos()], -1)
    size = math.log(SIGMA_PX * RADIUS / (width / (2 * math.tan(FOV / 2)))) + 0.8 * draw.normal(n)
    return SplatScene({"means": centers[cluster] + 0.5 * draw.normal(n, 3)} | draw.appearance(size), width, height)


def view_of_share(scene: SplatScene, share: float, turn: float) -> GaussianRasterizationSettings:
    """Return a camera that looks away from the ring's axis, `turn` radians from +z, and sees a share of the means.

    A camera that moves backwards along its axis sees more and more, from a few Gaussians behind the ring on its far
    side to all of them.
    """
    means = scene.parameters["means"][:: max(1, len(scene.parameters["means"]) // 100_000)].double()
    nearest, farthest = -1.2 * RADIUS, _FARTHEST
    for _ in range(_STEPS):
        back = (nearest + farthest) / 2
        seen = _share(means, scene, _view(turn, back))
        nearest, farthest = (back, farthest) if seen < share else (nearest, back)
    camera = settings(scene.width, scene.height, torch.float32, view=_view(turn, farthest))
    return on_device(camera, scene.parameters["means"].device)


def _view(turn: float, back: float) -> Tensor:
    """World to view, of a camera that stands `back` behind the origin."""
    view = torch.eye(4, dtype=torch.float64)
    sine, cosine = math.sin(turn), math.cos(turn)
    view[0, 0], view[0, 2], view[2, 0], view[2, 2] = cosine, -sine, sine, cosine
    view[2, 3] = back
    return view


def _share(means: Tensor, scene: SplatScene, view: Tensor) -> float:
    """The share of the means that lie on the image."""
    view = view.to(means.device)
    x, y, z = (means @ view[:3, :3].T + view[:3, 3]).T
    wide = math.tan(FOV / 2)
    high = wide * scene.height / scene.width
    return float(((z > 0.2) & (x.abs() < wide * z) & (y.abs() < high * z)).double().mean())
