"""Masks of what one photo shows and the others do not, such as passers-by (--robust_mask)."""

from collections.abc import Iterator
from typing import Any

from torch import Tensor

from gaussian_renderer.scored_views import ScoredViews
from groundwork.finding import Finding, note
from groundwork.host.listing import some
from scene.cameras import Camera
from scene.scene import Scene
from splatting.features.robust_mask_residuals import (
    FEW,
    MASKED,
    MOST_PHOTOS,
    Residuals,
    odd_share,
    residuals_of,
    write_masks,
)
from splatting.iteration import Iteration
from splatting.part import Error, Needs, Part


class RobustMask(Part):
    """Leaves pixels out of the loss by the residuals of all photos so far, and writes these pixels at the end.

    No step is taken twice, because the second time would find the residuals of the first.
    """

    name = "robust_mask"
    needs = Needs(ranks=False)

    def begin(self, run: Any, state: Any) -> None:
        """Begin with the residuals of a checkpoint, or with none, and filter the pixels of the loss by them."""
        self._run = run
        self.residuals = Residuals(run.scene.getTrainCameras(), run.opt.robust_mask, run.device)
        if state is not None:
            self.residuals.restore(state)
        run.pixel_filter = self

    def mask(self, at: Iteration, image: Tensor, target: Tensor, mask: Tensor | None) -> Tensor | None:
        """Return the pixels that count in a step, within a mask. Residuals teach nothing after opacities were reset."""
        learns = not at.density.recovers
        return self.residuals.mask(at.camera, image, target, mask, learns)

    def counted(self, camera: Camera) -> Tensor | None:
        """Return the pixels of a view that count now."""
        return self.residuals.counted(camera)

    def after_step(self, at: Iteration) -> None:
        self.residuals.keep()

    def state(self) -> dict[str, Any]:
        return self.residuals.captured()

    def ended(self, error: Error) -> None:
        if error is None:
            run = self._run
            run.log.tell(write_masks(self.residuals, run.scene.model_path, run.dataset.source_path, run.background))

    @staticmethod
    def advise_trained(scene: Scene, views: ScoredViews) -> Iterator[Finding]:
        """Measure which differences the short training leaves."""
        share = odd_share(residuals_of(scene.getTrainCameras(), views, scene.gaussians))
        text = f"{share:.0%} of the photos have passers-by, reflections or other things that change"
        text = text if share else "no photo has passers-by, reflections or other things that change"
        yield note(text, f"--robust_mask {MASKED:g}" if share > FEW else "")

    @staticmethod
    def examine(scene: Scene, views: ScoredViews) -> Iterator[Finding]:
        """Find photos that show what the model does not."""
        from arguments import read_training_options

        cameras = scene.getTrainCameras()
        taken = bool(read_training_options(scene.model_path).get("robust_mask"))
        if len(cameras) > MOST_PHOTOS or scene.halves or taken:
            return
        masks = residuals_of(cameras, views, scene.gaussians)
        found = {camera.image_name: masks.counted(camera) for camera in cameras}
        shares = {name: 1 - float(counts.float().mean()) for name, counts in found.items() if counts is not None}
        if worst := sorted(shares, key=shares.get, reverse=True):
            text = f"{len(worst)} of {len(cameras)} photos show what the model does not, such as passers-by or"
            yield note(f"{text} reflections: most in {some(worst)}", f"--robust_mask {MASKED:g}")
