"""The message for rendering or training that runs out of memory: what was needed, what is free, and a remedy."""

import contextlib
from collections.abc import Iterator, Sequence

from groundwork.host.memory import describe_shortage, is_out_of_memory
from scene.cameras import Camera, MiniCam
from scene.gaussian_model import GaussianModel
from utils.system_utils import UserError


@contextlib.contextmanager
def explain_memory_errors(
    gaussians: GaussianModel,
    cameras: Sequence[Camera | MiniCam],
    remedy: str = "lower --resolution (-r)",
    what: str = "rendering",
) -> Iterator[None]:
    """Replace an out-of-memory error in the block, which renders these views, by a UserError.

    remedy: advice that saves memory, for the message.
    what: the activity, for the message.
    """
    try:
        yield
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        raise UserError(
            f"{what} ran out of memory ({_describe_situation(error, gaussians, cameras)}); {remedy}, or free memory "
            "that other programs use"
        ) from error


def _describe_situation(error: BaseException, gaussians: GaussianModel, cameras: Sequence[Camera | MiniCam]) -> str:
    """The memory asked for and free, the number of Gaussians, and the size of the largest view."""
    parts = [describe_shortage(error, gaussians.get_xyz.device), f"{len(gaussians):,} Gaussians"]
    if cameras:
        largest = max(cameras, key=lambda camera: camera.image_width * camera.image_height)
        parts.append(f"images of {largest.image_width} x {largest.image_height}")
    return "; ".join(parts)
