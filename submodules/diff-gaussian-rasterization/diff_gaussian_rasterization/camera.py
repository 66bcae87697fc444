"""The camera as numbers that receive a gradient. Autograd takes it on to the tensors of the settings."""

import torch
from torch import Tensor

from diff_gaussian_rasterization.first_order import needs_function
from diff_gaussian_rasterization.lens import LENS_VALUES
from diff_gaussian_rasterization.scene import Scene
from diff_gaussian_rasterization.settings import GaussianRasterizationSettings

_RAY_LIMIT = 1.3  # kJacobianClamp in csrc/math/constants.h
_PLAIN = 3  # numbers of Scene.lens before those of a lens
_VALUES = _PLAIN + 7  # where Lens.values begin


def camera_numbers(scene: Scene, settings: GaussianRasterizationSettings) -> Tensor | None:
    """The numbers of the settings' camera, (25,) or with a lens (34,) float64; None if no gradient of them is needed.

    Rows and translation of the view, centre, limits of the rays, then of a pinhole the focal lengths of the Jacobian,
    the principal point and the focal lengths of means (px), or the values of the lens.
    """
    tangents = settings.tanfovx, settings.tanfovy
    given = *scene[8:11], settings.lens_values, *tangents
    if not needs_function(*(values for values in given if isinstance(values, Tensor))):
        return None
    double = {"dtype": torch.float64, "device": scene.means.device}
    view, projection, center = (values.to(**double) for values in scene[8:11])
    rows = view[:3, :3].T
    size = torch.tensor(scene.size[::-1], **double)
    if settings.lens is None:
        # The projection's own entries: inverse(view) @ full, by dual rows as in csrc/math/camera.h.
        dual = torch.linalg.cross(rows.roll(-1, 0), rows.roll(-2, 0))
        entries = dual @ projection[:3, :2] / (rows[0] @ dual[0])
        given = torch.stack([torch.as_tensor(tan, **double) for tan in tangents])
        shift, tangent = entries[2], torch.where(given > 0, given, 1 / entries.diagonal().abs().detach())
        own = torch.cat([size / (2 * tangent), (size * (1 + shift) - 1) / 2, size / 2 * entries.diagonal()])
    else:
        own = (
            torch.tensor(scene.lens[_VALUES : _VALUES + LENS_VALUES], **double)
            if settings.lens_values is None
            else settings.lens_values
        )
        own = own.to(**double)
        reach = scene.lens[_PLAIN + 2]
        shift, tangent = (2 * own[2:4] + 1) / size - 1, reach * size / (2 * own[:2])
    limits = torch.stack([(-_RAY_LIMIT - shift) * tangent, (_RAY_LIMIT - shift) * tangent], 1)
    return torch.cat([rows.reshape(9), view[3, :3], center, limits.reshape(4), own])
