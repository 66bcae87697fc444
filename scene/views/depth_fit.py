"""Scale and offset of a depth map, as the reference's `depth_params` give them."""

from collections.abc import Mapping
from typing import NamedTuple

from scene.readers.depth_maps import RELIABLE


class DepthFit(NamedTuple):
    """Inverse depth = value * scale + offset, and whether to train on it."""

    scale: float = 1.0
    offset: float = 0.0
    reliable: bool = True


def depth_fit(params: Mapping[str, float] | None) -> DepthFit:
    """The fit that `scale`, `offset` and the scene's median scale `med_scale` tell; None: the map is used as it is.

    A scale that is not positive is not applied. One far from the median is not reliable.
    """
    if params is None:
        return DepthFit()
    scale, median = params["scale"], params["med_scale"]
    reliable = median / RELIABLE <= scale <= median * RELIABLE
    return DepthFit(scale, params["offset"], reliable) if scale > 0 else DepthFit(reliable=reliable)
