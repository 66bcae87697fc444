"""The loss of a rendered inverse depth against a map."""

from torch import Tensor

from scene.cameras import Camera
from utils.loss_utils import inverse_depth_loss


def depth_loss(inverse_depth: Tensor, camera: Camera, mask: Tensor | None) -> Tensor:
    """Mean |difference| of an inverse depth (1, H, W) from the camera's map, where the map has a value.

    mask: (1, H, W) bool, pixels that count; None: all.
    """
    target = camera.target_inverse_depth
    if camera.depth_has_gaps:
        mask = target > 0 if mask is None else mask & (target > 0)
    return inverse_depth_loss(inverse_depth, target, camera.columns, mask)
