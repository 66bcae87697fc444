"""Make a copy of a COLMAP scene in another unit: cameras and points times a factor; the photos are links.

python -m tests.scaled_scene SCENE FACTOR OUT
"""

import sys
from pathlib import Path

import numpy as np
import pycolmap


def scaled_scene(source: Path, factor: float, out: Path) -> Path:
    """Write the scene into a new folder, and return that."""
    model = pycolmap.Reconstruction(source / "sparse" / "0")
    model.transform(pycolmap.Sim3d(factor, pycolmap.Rotation3d(), np.zeros(3)))
    (out / "sparse" / "0").mkdir(parents=True)
    model.write_binary(str(out / "sparse" / "0"))
    (out / "images").symlink_to((source / "images").resolve())
    return out


if __name__ == "__main__":
    scaled_scene(Path(sys.argv[1]), float(sys.argv[2]), Path(sys.argv[3]))
