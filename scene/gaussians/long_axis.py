"""Splitting along the longest axis (Deng et al. 2025, Improved-GS) so that the moments stay; no random numbers.

A parent of standard deviation s along its longest axis has two children on that axis, SHIFT s to either side of its
centre, with the standard deviation SHRINK s along it, SHRINK^2 = 1 - SHIFT^2. All else is the parent's. The equal
mixture of the two has the parent's mean and covariance. SHIFT is the largest one whose mixture has a single maximum: it
has two as soon as a child's centre is further out than the child's own standard deviation.

Opacity: a bright patch should stay as bright. The parent covers a mean part a of its footprint g, with integral A:
a A. Children of opacity c cover 2 c g' - c^2 g'_1 g'_2, as light passes one after the other. With A' = SHRINK A and the
integral of g'_1 g'_2, A' OVERLAP / 2, where OVERLAP = exp(-(SHIFT / SHRINK)^2), seen across the axis,
    2 c - c^2 OVERLAP / 2 = a / SHRINK,
and c is its smaller root. For children that coincide (Rota Bulo et al. 2024 take 1 - sqrt(1 - a)) this asks for the sum
over the footprint what their rule asks for its centre alone. A faint Gaussian's c is a / (2 SHRINK), so that the sum of
the children has the parent's moments with its mass; for an opaque one, c is 0.76.

Only operations that IEEE 754 rounds in one way: every device and number of threads gives the same bits.
"""

import math

import torch
from torch import Tensor

from groundwork.deterministic.portable_math import exp, log
from scene.gaussians.attributes import Rows

SHIFT = math.sqrt(0.5)
SHRINK = math.sqrt(1.0 - SHIFT * SHIFT)
OVERLAP = math.exp(-((SHIFT / SHRINK) ** 2))
_SHORTEST = 1e-24  # square of a quaternion's length; a shorter one does not turn


def long_axis_children(xyz: Tensor, scaling: Tensor, rotation: Tensor, opacity: Tensor) -> Rows:
    """Centres (2n, 3), log scales (2n, 3) and logits of the opacity (2n, 1) of the two children of n parents, by name.

    Parents are given raw, in float32: xyz (n, 3) world units, log scales (n, 3), quaternions (n, 4) wxyz of any length,
    logits (n, 1). First come the children of all parents on one side, then those on the other. What is not returned is
    the parent's. Of axes of the same length the first is split.
    """
    axis = _find_longest(scaling)
    length = exp(scaling.gather(1, axis)) * SHIFT
    offset = _compute_direction(rotation, axis) * length
    shorter = scaling.scatter(1, axis, scaling.gather(1, axis) + math.log(SHRINK))
    return {
        "xyz": torch.cat((xyz + offset, xyz - offset)).float(),
        "scaling": shorter.repeat(2, 1),
        "opacity": _compute_child_logit(opacity).float().repeat(2, 1),
    }


def _find_longest(scaling: Tensor) -> Tensor:
    """Index (n, 1) of the largest of log scales (n, 3), the first of several; argmax may give any of them."""
    x, y, z = scaling.unbind(1)
    first, second = (x >= y) & (x >= z), y >= z
    return torch.where(first, 0, torch.where(second, 1, 2))[:, None]


def _compute_direction(rotation: Tensor, axis: Tensor) -> Tensor:
    """Unit vectors (n, 3) float64 of one axis each, (n, 1), of Gaussians turned by quaternions (n, 4) wxyz."""
    q = rotation.to(torch.float64)
    w, x, y, z = q.unbind(1)
    half = ((w * w + x * x) + (y * y + z * z)).clamp_min(_SHORTEST) * 0.5
    columns = (
        (half - (y * y + z * z), x * y + w * z, x * z - w * y),
        (x * y - w * z, half - (x * x + z * z), y * z + w * x),
        (x * z + w * y, y * z - w * x, half - (x * x + y * y)),
    )
    matrices = torch.stack([torch.stack(column, dim=1) for column in columns], dim=1) / half[:, None, None]
    return matrices.gather(1, axis[:, :, None].expand(-1, 1, 3))[:, 0]


def _compute_child_logit(opacity: Tensor) -> Tensor:
    """Logits (n, 1) float64 of the children's opacity c of the module's equation, from the parents' logits (n, 1)."""
    parts = 1.0 / (1.0 + exp(-opacity)) * (1.0 / SHRINK)
    root = exp(log(1.0 - parts * (OVERLAP / 2.0)) * 0.5)
    child = parts / (1.0 + root)
    return log(child) - log(1.0 - child)
