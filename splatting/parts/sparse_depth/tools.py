"""Whether a scene asks for the depth of its points."""

from collections.abc import Iterator, Sequence

from scene.readers.tracks import Track
from scene.scene import Scene
from splatting.findings import Finding, note

FEW_PHOTOS = 16  # 14 gained 0.2 dB by points that hold the depth, 20 and 21 lost as much (docs/results/options.md)


def advise(scene: Scene, tracks: Sequence[Track | None]) -> Iterator[Finding]:
    """Numbers of a scene, and the options that they speak for."""
    if any(tracks):
        count = len(scene.info.train_cameras)
        yield note(f"{count} photos train", "--sparse_depth 0.1" if count < FEW_PHOTOS else "")
