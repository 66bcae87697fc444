"""A region that photos are of (--region): what lies outside weighs less in the loss, and grows less."""

import math
from typing import TYPE_CHECKING, Any

from splatting.training.option import Option
from splatting.training.part import Options, Part

if TYPE_CHECKING:
    from torch import Tensor

    from scene.cameras import Camera
    from splatting.training.iteration import Iteration, Term

OUTSIDE = 0.1  # weight of a pixel outside, beside one inside
VALID = 'auto, a sphere "X Y Z RADIUS", or a box "X0 Y0 Z0 X1 Y1 Z1" with the smaller corner first'


def numbers_of(text: str) -> list[float] | None:
    """Four numbers of a sphere, or six of a box; None: they are to be found. ValueError for anything else."""
    if text == "auto":
        return None
    numbers = [float(word) for word in text.replace(",", " ").split()]
    sphere = len(numbers) == 4 and numbers[3] > 0
    box = len(numbers) == 6 and all(low < high for low, high in zip(numbers[:3], numbers[3:], strict=True))
    if not (all(map(math.isfinite, numbers)) and (sphere or box)):
        raise ValueError(f"must be {VALID}, got {text!r}")
    return numbers


def problem(text: str) -> str | None:
    """What --region may be, where it is something else; empty: no region."""
    try:
        return numbers_of(text) and None if text else None
    except ValueError:
        return VALID


class Region(Part):
    """Weighs the gradient of a render: pixels whose rays meet the region have ten times the weight of the others.

    The mean over all pixels of the training views is 1. What other parts add to the loss of colours weighs less
    outside, too, and so does what density control sums up: the region gets Gaussians that its surroundings had.
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
        from utils.system_utils import UserError

        self.shape = found(numbers_of(run.opt.region), run.scene)
        seen = [self.shape.seen(camera) for camera in run.scene.getTrainCameras()]
        inside = sum(int(mask.sum()) for mask in seen) / sum(mask.numel() for mask in seen)
        if inside in (0, 1):
            seen_by = "all pixels" if inside else "no pixel"
            raise UserError(f"{seen_by} of the training photos would see --region, so it changes nothing; give another")
        print(f"--region: {100 * inside:.1f} % of the photos' pixels see it")
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
