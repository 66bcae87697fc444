"""The ranks that have to render a model together."""

from typing import Any

from splatting.distributed.ranks import ALONE, Ranks


def ranks_of(model: Any) -> Ranks:
    """The ranks among which a model's Gaussians are divided; `ALONE` for a whole model, of any class."""
    return getattr(getattr(model, "shards", None), "ranks", ALONE)
