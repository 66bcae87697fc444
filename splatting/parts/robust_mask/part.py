"""Masks of what one photo shows and the others do not, such as passers-by (--robust_mask)."""

from typing import TYPE_CHECKING, Any

from splatting.option import Option, within
from splatting.part import Error, Needs, Options, Part, fill

if TYPE_CHECKING:
    from torch import Tensor

    from scene.cameras import Camera
    from splatting.training.iteration import Iteration


class RobustMask(Part):
    """Leaves pixels out of the loss by the residuals of all photos so far, and writes at the end what it has left out.

    A step that is taken twice would find the residuals of its first time.
    """

    name = "robust_mask"
    tools = "advise_trained", "examine", "pictures"
    # fmt: off
    options = Options(optimisation=(
        Option("robust_mask", 0.0, origin="ours", check=within(0, 0.5), topic="photos that vary",
            help="largest part of a photo that training may ignore because the other photos do not show it, as with "
                 "passers-by; 0: off"),
    ))
    # fmt: on
    needs = Needs(ranks=False)

    def begin(self, run: Any, state: Any) -> None:
        from splatting.parts.robust_mask.residuals import Residuals

        self._run = run
        self.residuals = Residuals(run.scene.getTrainCameras(), run.opt.robust_mask, run.device)
        if state is not None:
            self.residuals.restore(state)
        fill(run, "counts", self, self)

    def mask(self, at: "Iteration", image: "Tensor", target: "Tensor", mask: "Tensor | None") -> "Tensor | None":
        """Pixels that count in a step, of those of a mask; after a reset of opacities, residuals teach nothing."""
        learns = not self._run.density.recovers(at.iteration)
        return self.residuals.mask(at.camera, image, target, mask, learns)

    def counted(self, camera: "Camera") -> "Tensor | None":
        """Pixels of a view that count now."""
        return self.residuals.counted(camera)

    def after_step(self, at: "Iteration") -> None:
        self.residuals.keep()

    def state(self) -> dict[str, Any]:
        return self.residuals.captured()

    def ended(self, error: Error) -> None:
        if error is None:
            from splatting.parts.robust_mask.written import write_masks

            run = self._run
            run.log.tell(write_masks(self.residuals, run.scene.model_path, run.dataset.source_path, run.background))
