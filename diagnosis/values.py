"""Values of a trained model that no longer training would mend: opacities, sizes, positions."""

from torch import Tensor

from diagnosis.lines import Line
from scene.gaussian_model import GaussianModel

RESET = (0.005, 0.0101)  # opacities after a reset to at most 0.01, which is below float32's 0.01; less is pruned
RESET_SHARE = 0.95
SIZES = (1e-6, 1.0)  # extents: medians of trained models are 1e-4 to 0.1
SPREADS = (0.01, 100.0)  # extents: from an object amid far cameras to a landscape beyond near ones


def wrong_sizes(gaussians: GaussianModel, extent: float) -> Line | None:
    """Line about sizes that are all far too small or too large for the cameras; None if they are not."""
    median = float(gaussians.get_scaling.detach().max(dim=1).values.median()) / extent
    low, high = SIZES
    if low <= median <= high:
        return None
    return Line(
        f"the Gaussians are too {'small' if median < low else 'large'} for these cameras: their median size is "
        f"{median:.2g} extents",
        "check what wrote or changed the PLY: scales are natural logarithms, in the units of the cameras",
    )


def wrong_positions(gaussians: GaussianModel, extent: float) -> Line | None:
    """Line about positions in other units than the cameras'; None if they fit."""
    spread = _spread(gaussians.get_xyz.detach()) / extent
    low, high = SPREADS
    if low <= spread <= high:
        return None
    return Line(
        f"the positions of the Gaussians spread over {spread:.2g} extents of the cameras",
        "check whether the model belongs to this dataset (-s), and what scaled the PLY: both need the same units",
    )


def only_reset(gaussians: GaussianModel) -> Line | None:
    """Line about opacities as a reset leaves them, with no training after it; None if they are others."""
    opacity = gaussians.get_opacity.detach()
    low, high = RESET
    share = float(((opacity >= low) & (opacity <= high)).float().mean())
    if share < RESET_SHARE:
        return None
    return Line(
        f"{share:.0%} of the opacities are near 0.01, as a reset leaves them, and nothing was trained after it",
        "check an earlier iteration, or train some 1000 iterations beyond the reset (--opacity_reset_interval)",
    )


def _spread(points: Tensor) -> float:
    return float((points - points.median(dim=0).values).norm(dim=1).median())
