"""What tools know of a sky: whether a scene asks for one, and which Gaussians of a model are its."""

from collections.abc import Iterator, Sequence
from typing import Any

from torch import Tensor

from scene.readers.tracks import Track
from scene.scene import Scene
from splatting.findings import Finding, note
from splatting.parts.sky.directions import FEWEST
from splatting.parts.sky.shell import Shell, find_sky, said_of_sky


def advise(scene: Scene, tracks: Sequence[Track | None]) -> Iterator[Finding]:
    """Numbers of a scene, and the options that they speak for."""
    if len(scene.info.point_cloud.points):
        _, share = find_sky(scene, Shell.around(scene.info))
        yield note(said_of_sky(share), "--sky auto" if share >= FEWEST else "")


def beside(facts: dict[str, Any], means: Tensor) -> Tensor | None:
    """Which Gaussians are far away, large and opaque by intent, (N,) bool; None: there is no sky.

    facts: of model.json. means: (N, 3) in the model's frame.
    """
    state = facts.get("sky")
    return Shell.restored(state).rows(means) if state else None
