"""The pinhole camera: where a point appears on the image, and how the image changes around it."""

from typing import NamedTuple

import torch
from torch import Tensor

from diff_gaussian_rasterization.settings import GaussianRasterizationSettings

NEAR = 0.2  # world units; a Gaussian whose depth is not above is culled
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


class Points(NamedTuple):
    """The means of N Gaussians as a camera sees them."""

    view: Tensor  # (N, 3) in view coordinates
    in_front: Tensor  # (N,) bool: beyond the near plane
    depth: Tensor  # (N,) z of the view; 1 where not in front, so that divisions stay finite
    pixel: Tensor  # (N, 2) px, pixel centres at integers


def camera_of(settings: GaussianRasterizationSettings) -> Camera:
    """The camera that the settings describe."""
    width, height = settings.image_width, settings.image_height
    world_to_view, world_to_clip = settings.viewmatrix.double(), settings.projmatrix.double()
    view_to_clip = torch.linalg.inv(world_to_view) @ world_to_clip
    return Camera(
        width,
        height,
        torch.tensor([width, height], dtype=torch.float64),
        torch.tensor([settings.tanfovx, settings.tanfovy], dtype=torch.float64),
        settings.campos.double(),
        world_to_view,
        world_to_clip,
        view_to_clip[2, :2],
    )


def project(means: Tensor, means2d: Tensor, camera: Camera) -> Points:
    """Projects means (N, 3) and adds means2d (N, 3), in NDC: zeros, whose gradient is that of the projected means."""
    view = _transformed(means, camera.world_to_view)[:, :3]
    clip = _transformed(means, camera.world_to_clip)
    in_front = view[:, 2] > NEAR
    depth = torch.where(in_front, view[:, 2], 1.0)
    ndc = clip[:, :2] / torch.where(in_front, clip[:, 3], 1.0)[:, None]
    pixel = ((ndc + 1) * camera.size - 1) / 2 + means2d[:, :2] * camera.size / 2
    return Points(view, in_front, depth, pixel)


def world_to_image(points: Points, camera: Camera) -> Tensor:
    """J W of Kerbl et al. 2023, eq. 5, in px per world unit: (N, 2, 3).

    W is the rotation into the view. J is the Jacobian of the perspective division (Zwicker et al. 2001, section 4.4)
    at a Gaussian's mean. Means far outside the image count as lying at RAY_LIMIT, where J is still moderate.
    """
    focal = camera.size / (2 * camera.tangents)  # px
    low, high = ((limit - camera.principal) * camera.tangents for limit in (-RAY_LIMIT, RAY_LIMIT))
    ray = points.view[:, :2] / points.depth[:, None]
    ray = torch.minimum(torch.maximum(ray, low), high)
    z, zero = points.depth, torch.zeros_like(points.depth)
    across = [focal[0] / z, zero, -focal[0] * ray[:, 0] / z]
    down = [zero, focal[1] / z, -focal[1] * ray[:, 1] / z]
    J = torch.stack(across + down, -1).reshape(-1, 2, 3)
    W = camera.world_to_view[:3, :3].T
    return J @ W


def _transformed(points: Tensor, matrix: Tensor) -> Tensor:
    """Points (N, 3) in homogeneous coordinates, transformed: (N, 4)."""
    return torch.cat([points, torch.ones_like(points[:, :1])], 1) @ matrix
