"""Whether photos of a scene show what a model does not, and the picture of what a training has left out."""

import argparse
from collections.abc import Iterator
from pathlib import Path

from arguments import read_training_options
from gaussian_renderer.scored_views import ScoredViews
from scene.scene import Scene
from splatting.findings import Finding, note
from splatting.host.listing import some
from splatting.parts.robust_mask.residuals import FEW, MASKED, MOST_PHOTOS, odd_share, residuals_of
from splatting.parts.robust_mask.written import PICTURE


def advise_trained(scene: Scene, views: ScoredViews) -> Iterator[Finding]:
    """What a short training of small photos leaves over, and the option that it speaks for."""
    share = odd_share(residuals_of(scene.getTrainCameras(), views, scene.gaussians))
    text = f"{share:.0%} of the photos show objects that a short training does not, such as passers-by"
    yield note(text, f"--robust_mask {MASKED:g}" if share > FEW else "")


def examine(scene: Scene, views: ScoredViews, options: argparse.Namespace) -> Iterator[Finding]:
    """Notes on a trained model."""
    cameras = scene.getTrainCameras()
    taken = bool(read_training_options(scene.model_path).get("robust_mask"))
    if len(cameras) > MOST_PHOTOS or scene.halves or taken:
        return
    masks = residuals_of(cameras, views, scene.gaussians)
    found = {camera.image_name: masks.counted(camera) for camera in cameras}
    shares = {name: 1 - float(counts.float().mean()) for name, counts in found.items() if counts is not None}
    if worst := sorted(shares, key=shares.get, reverse=True):
        text = f"{len(worst)} of {len(cameras)} photos show objects that the model does not, such as passers-by"
        yield note(f"{text}: most in {some(worst)}", f"--robust_mask {MASKED:g}")


def pictures(model: Path) -> list[Path]:
    """Pictures in a model folder that reports show."""
    return [model / PICTURE]
