"""An order of a model's Gaussians by need: the first n, for any n, are a model, too.

Without a Gaussian a pixel changes by the opacity times minus its derivative, exactly, as it is linear in each opacity.
A view's squared error against the whole model's image then changes by a sum over pixels of 2 E d + d^2, with E the
error of those that went before, and d the change. The first term is one backward. The second is the mean square of a
sum with random signs (Hutchinson 1990), so it is another one. The sum over the views is what a Gaussian adds.

Gaussians that are removed together may hide the same pixels. So few are removed at a time, and the sums are computed
again for the rest.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_renderer.scored_views import ScoredViews
from groundwork.host.progress import Bar
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from utils.sh_utils import C0

_SOLID = 1e-3  # least transparency in the derivative by an opacity
_SHARE = 0.1  # of the Gaussians left, which go together
# Of the first term: Gaussians at one place repair the same error, and with all of it the first ones to go repair it
# again and again: "fox" with half of its rows lost 6.6 dB in place of 1.0.
_TRUST = 0.2
_MEMORY = 0.8  # weight of earlier rounds in the second term, whose signs are others in each
# What other views have behind a Gaussian differs by so much more from its colour than what these views have there. It
# adds squares of blending weights, without which "bonsai" with half of its rows lost 0.3 dB more.
_BEHIND = 0.1
_ALIKE = 0.125  # of the count asked for: the last ones are not asked again


def change_without(values: Tensor, gaussians: GaussianModel, factors: Tensor | None = None) -> Tensor:
    """The change of a sum of rendered values times factors without each Gaussian, by the derivative: (N,) float64."""
    (slope,) = torch.autograd.grad(values, gaussians.raw("opacity"), factors, retain_graph=True)
    return _compute_removal(slope, gaussians)


def _compute_removal(slope: Tensor, gaussians: GaussianModel) -> Tensor:
    """Opacity times minus the derivative by it, from the derivative by its logit (N, 1): (N,) float64."""
    transparency = (1 - gaussians.get_opacity.detach()[:, 0]).clamp_min(_SOLID)
    return -(slope[:, 0] / transparency).double()


@torch.no_grad()
def most_needed(gaussians: GaussianModel, cameras: Sequence[Camera], views: ScoredViews, count: int) -> Tensor:
    """Indices (n,) int64 of the `count` Gaussians, or of all, that the views need most, the most needed first."""
    count = min(count, len(gaussians))
    signs = torch.Generator(gaussians.get_xyz.device).manual_seed(0)
    left, gone, squares = torch.arange(len(gaussians), device=gaussians.get_xyz.device), [], None
    with Bar(desc="Ordering Gaussians", unit="round", leave=False) as bar:
        while len(left):
            part = gaussians.part(left, gaussians.max_sh_degree)
            errors, now = torch.zeros(2, len(left), dtype=torch.float64, device=left.device)
            for camera in cameras:  # the whole model's images of many photos would not fit into the memory
                first, second = _compute_terms(camera, part, views, views.image(camera, gaussians), signs)
                errors, now = errors + first, now + second
            squares = now if squares is None else _MEMORY * squares + (1 - _MEMORY) * now
            order = torch.argsort((_TRUST * errors + squares).nan_to_num(0.0), descending=True, stable=True)
            stay = int((1 - _SHARE) * len(left)) if len(left) > _ALIKE * count else 0
            stay = max(stay, count) if len(left) > count else stay
            gone.append(left[order[stay:]])
            kept = order[:stay].sort().values
            left, squares = left[kept], squares[kept]
            bar.update()
    return torch.cat([left, *reversed(gone)])[:count]


def _compute_terms(
    camera: Camera, part: GaussianModel, views: ScoredViews, whole: Tensor, signs: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Both terms (N,) float64 of the growth of the mean squared error of a part's view against the whole model's."""
    with torch.enable_grad():
        image = views.image(camera, part)
    mask = views.mask(camera)
    counted = torch.ones_like(image[:1]) if mask is None else mask
    random = torch.randint(0, 2, image.shape, device=image.device, generator=signs) * 2.0 - 1.0
    first = change_without(image, part, 2 * counted * (image.detach() - whole))
    parameters = part.raw("opacity"), part.raw("f_dc")
    slope, tint = torch.autograd.grad(image, parameters, counted * random)
    weights = tint[:, 0].double() / C0
    second = _compute_removal(slope, part).square() + (_BEHIND * weights).square().sum(dim=1)
    return first / image.numel(), second / image.numel()
