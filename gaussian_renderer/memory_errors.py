"""Where memory does not suffice a sentence says what was wanted, what there is, and what helps."""

import contextlib
from collections.abc import Iterator, Sequence

from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from utils.host.memory import is_out_of_memory, shortage
from utils.system_utils import UserError


@contextlib.contextmanager
def memory_errors_explained(gaussians: GaussianModel, cameras: Sequence[Camera]) -> Iterator[None]:
    """UserError in place of an error for want of memory while these views are rendered."""
    try:
        yield
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        raise UserError(
            f"memory did not suffice for rendering ({situation(error, gaussians, cameras)}); lower --resolution (-r), "
            "or free memory that other programs use"
        ) from error


def situation(error: BaseException, gaussians: GaussianModel, cameras: Sequence[Camera]) -> str:
    """What was wanted, what is free, how many Gaussians there are, and how large the largest view is."""
    parts = [shortage(error, gaussians.get_xyz.device), f"{len(gaussians):,} Gaussians"]
    if cameras:
        largest = max(cameras, key=lambda camera: camera.image_width * camera.image_height)
        parts.append(f"pictures of {largest.image_width} x {largest.image_height}")
    return "; ".join(parts)
