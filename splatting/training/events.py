"""What a training writes for TensorBoard. The tags are the reference's."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import Tensor

    from scene.cameras import Camera
    from scene.gaussian_model import GaussianModel

INTERVAL = 10  # iterations between losses: reading one waits for the GPU


class Events:
    """Writes events of one iteration by a SummaryWriter."""

    def __init__(self, writer: Any, iteration: int) -> None:
        self._writer = writer
        self._iteration = iteration

    def losses(self, l1: "Tensor", total: "Tensor", seconds: float) -> None:
        """Of every tenth iteration, and the seconds that it took."""
        if self._iteration % INTERVAL == 0:
            self._scalar("train_loss_patches/l1_loss", l1.item())
            self._scalar("train_loss_patches/total_loss", total.item())
            self._scalar("iter_time", seconds * 1000.0)

    def image(self, views: str, camera: "Camera", what: str, image: "Tensor") -> None:
        """An image (3, H, W) of a view. views: the name of its set."""
        self._writer.add_image(f"{views}_view_{camera.image_name}/{what}", image, global_step=self._iteration)

    def scores(self, views: str, means: Mapping[str, float]) -> None:
        """Mean scores of a set of views: l1 and psnr."""
        for kind, value in means.items():
            self._scalar(f"{views}/loss_viewpoint - {kind.replace('l1', 'l1_loss')}", value)

    def model(self, gaussians: "GaussianModel") -> None:
        """Its opacities, and how many Gaussians it has."""
        self._writer.add_histogram("scene/opacity_histogram", gaussians.get_opacity, self._iteration)
        self._scalar("total_points", len(gaussians))

    def _scalar(self, tag: str, value: float) -> None:
        self._writer.add_scalar(tag, value, self._iteration)
