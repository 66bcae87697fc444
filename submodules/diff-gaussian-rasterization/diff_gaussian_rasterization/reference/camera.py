"""The camera: where a point appears on the image, and how the image changes around it."""

from typing import NamedTuple

import torch
from torch import Tensor

from diff_gaussian_rasterization.lens import Lens
from diff_gaussian_rasterization.reference import lens as lenses
from diff_gaussian_rasterization.settings import GaussianRasterizationSettings

RAY_LIMIT = 1.3  # half images from the centre; beyond it the Jacobian is taken at this limit


class Camera(NamedTuple):
    """A camera in float64. Matrices act on row vectors: point @ matrix."""

    width: int  # px
    height: int
    size: Tensor  # (2,) width and height
    tangents: Tensor  # (2,) of half the field of view, across and down
    center: Tensor  # (3,) world
    world_to_view: Tensor  # (4, 4); x right, y down, z forward
    world_to_clip: Tensor  # (4, 4)
    principal: Tensor  # (2,) NDC: where the optical axis meets the image, 0 in its middle
    lens: Lens | None  # in place of a pinhole
    dilation: float  # px^2, added to both variances on the image
    near: float  # depth


class Points(NamedTuple):
    """The means of N Gaussians as a camera sees them."""

    view: Tensor  # (N, 3) in view coordinates
    in_front: Tensor  # (N,) bool: beyond the near plane, and where the lens shows points
    depth: Tensor  # (N,) z, or the distance in a fisheye or panorama; 1 where not in front: divisions stay finite
    pixel: Tensor  # (N, 2) px, pixel centres at integers
    shift: Tensor  # (N, 2) px: zeros, part of `pixel`


def camera_of(settings: GaussianRasterizationSettings) -> Camera:
    """The camera that the settings describe."""
    width, height = settings.image_width, settings.image_height
    world_to_view, world_to_clip = settings.viewmatrix.double(), settings.projmatrix.double()
    view_to_clip = torch.linalg.inv(world_to_view) @ world_to_clip
    tangents = torch.tensor([settings.tanfovx, settings.tanfovy], dtype=torch.float64)
    own = 1 / view_to_clip.diagonal()[:2].abs()  # those of the projection
    return Camera(
        width,
        height,
        torch.tensor([width, height], dtype=torch.float64),
        torch.where(tangents > 0, tangents, own),
        settings.campos.double(),
        world_to_view,
        world_to_clip,
        view_to_clip[2, :2],
        settings.lens,
        settings.dilation,
        settings.near,
    )


def project(means: Tensor, means2d: Tensor, camera: Camera) -> Points:
    """Projects means (N, 3) and adds means2d (N, 3), in NDC: zeros, whose gradient is that of the projected means."""
    view = _transform(means, camera.world_to_view)[:, :3]
    clip = _transform(means, camera.world_to_clip)
    shift = means2d[:, :2] * camera.size / 2
    if camera.lens is not None:
        return _project_by_lens(view, shift, camera)
    in_front = view[:, 2] > camera.near
    depth = torch.where(in_front, view[:, 2], 1.0)
    ndc = clip[:, :2] / torch.where(in_front, clip[:, 3], 1.0)[:, None]
    return Points(view, in_front, depth, ((ndc + 1) * camera.size - 1) / 2 + shift, shift)


def _project_by_lens(view: Tensor, shift: Tensor, camera: Camera) -> Points:
    """Project points (N, 3) of the view by the camera's lens.

    shift: (N, 2) px, added to the pixels.
    """
    lens = camera.lens
    _, limit, *_ = lens.numbers(camera.width, camera.height)
    depth = view[:, 2] if lens.chart == "perspective" else view.norm(dim=1)
    off_axis = torch.hypot(view[:, 0], view[:, 1])
    field = off_axis / depth if lens.chart == "perspective" else torch.atan2(off_axis, view[:, 2])
    in_front = (depth > camera.near) & (field * field <= limit)
    view, depth = torch.where(in_front[:, None], view, 1.0), torch.where(in_front, depth, 1.0)
    return Points(view, in_front, depth, lenses.pixels(lens, view) + shift, shift)


def world_to_image(points: Points, camera: Camera) -> Tensor:
    """J W of Kerbl et al. 2023, eq. 5, in px per world unit: (N, 2, 3). W is the rotation into the view.

    Means far outside the image count as lying at RAY_LIMIT, where J is still moderate.
    """
    return jacobians(points._replace(view=_clamp_to_limit(points, camera)), camera) @ camera.world_to_view[:3, :3].T


def jacobians(points: Points, camera: Camera) -> Tensor:
    """J (N, 2, 3), px per unit: the Jacobian of the projection (Zwicker et al. 2001, section 4.4) at points.view."""
    if camera.lens is not None:
        return lenses.jacobians(camera.lens, points.view)
    focal = camera.size / (2 * camera.tangents)  # px
    ray, z, zero = points.view[:, :2] / points.depth[:, None], points.depth, torch.zeros_like(points.depth)
    across = [focal[0] / z, zero, -focal[0] * ray[:, 0] / z]
    down = [zero, focal[1] / z, -focal[1] * ray[:, 1] / z]
    return torch.stack(across + down, -1).reshape(-1, 2, 3)


def _clamp_to_limit(points: Points, camera: Camera) -> Tensor:
    """The points (N, 3) of the same depth on rays within RAY_LIMIT, where rays are a pinhole's."""
    if camera.lens is None:
        low, high = ((limit - camera.principal) * camera.tangents for limit in (-RAY_LIMIT, RAY_LIMIT))
    elif camera.lens.chart == "perspective":
        _, _, reach, *_ = camera.lens.numbers(camera.width, camera.height)
        center, focal = (torch.tensor(t, dtype=torch.float64) for t in (camera.lens.center, camera.lens.focal))
        half = camera.size / 2
        low, high = (reach * (half * (1 + limit) - 0.5 - center) / focal for limit in (-RAY_LIMIT, RAY_LIMIT))
    else:
        return points.view
    ray = points.view[:, :2] / points.depth[:, None]
    ray = torch.minimum(torch.maximum(ray, low), high)
    return torch.cat([ray * points.depth[:, None], points.view[:, 2:]], 1)


def _transform(points: Tensor, matrix: Tensor) -> Tensor:
    """Points (N, 3) in homogeneous coordinates, transformed: (N, 4)."""
    return torch.cat([points, torch.ones_like(points[:, :1])], 1) @ matrix
