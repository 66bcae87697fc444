"""A region that photos are of (--region): what lies outside weighs less in the loss, and grows less."""

from typing import TYPE_CHECKING, Any

from splatting.parts.region.numbers import problem
from splatting.training.option import Option
from splatting.training.part import Options, Part

if TYPE_CHECKING:
    from torch import Tensor

    from scene.cameras import Camera
    from splatting.training.iteration import Iteration, Term

OUTSIDE = 0.1  # weight of a pixel outside, beside one inside


class Region(Part):
    """Weighs the gradient of a render: pixels whose rays meet the region have ten times the weight of the others.

    The mean over all pixels of the training views is 1. So the terms of other parts weigh less outside, too, and so
    does what density control sums up: the region gets Gaussians that its surroundings had.
    """

    name = "region"
    tools = "add_export_options", "left_out"
    # fmt: off
    options = Options(optimisation=(
        Option("region", "", origin="ours", check=problem, topic="quality and speed", unset="the whole scene",
            help="what the photos are of, in the scene's coordinates: a sphere as \"X Y Z RADIUS\", a box as "
                 "\"X0 Y0 Z0 X1 Y1 Z1\", or auto: a sphere around the point that the cameras look at. What lies "
                 "outside weighs a tenth in the loss; export.py --only_region leaves it out"),
    ))
    # fmt: on

    def begin(self, run: Any, state: Any) -> None:
        from splatting.parts.region.shape import found

        self.shape = found(run.opt.region, run.scene)
        seen = [self.shape.seen(camera) for camera in run.scene.getTrainCameras()]
        inside = sum(int(mask.sum()) for mask in seen) / sum(mask.numel() for mask in seen)
        self._mean = OUTSIDE + (1 - OUTSIDE) * inside

    def terms(self, at: "Iteration") -> "dict[str, Term]":
        def term(package: dict[str, Any], _: Any) -> "Tensor":
            image, weights = package["render"], self.weights(at.camera)
            image.register_hook(lambda gradient: gradient * weights)
            return image.new_zeros(())

        return {self.name: term}

    def weights(self, camera: "Camera") -> "Tensor":
        """(1, H, W): of the pixels of a view."""
        return (OUTSIDE + (1 - OUTSIDE) * self.shape.seen(camera)) / self._mean

    def facts(self) -> dict[str, Any]:
        return {self.name: self.shape.facts()}
