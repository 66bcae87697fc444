"""A COLMAP scene whose cameras have turned and moved: its photos, its points and tracks, and other poses.

    python -m benchmarks.scenes.poses SCENE OUT --degrees 0.3 --percent 0.5 --seed 0

Each camera turns by so many degrees about a random axis, and its centre moves by so many percent of the extent in a
random direction.
"""

import argparse
from pathlib import Path

import numpy as np

from scene.dataset_readers import read_scene
from scene.reprojection import moved_pose
from utils.system_utils import UserError, run_cli


def disturb_poses(scene: Path, out: Path, degrees: float, percent: float, seed: int) -> Path:
    """Write a scene with the photos of another, whose cameras have turned and moved in random directions."""
    import pycolmap  # after Pillow

    model, rng = pycolmap.Reconstruction(str(scene / "sparse" / "0")), np.random.default_rng(seed)
    extent = read_scene(scene, "images", hold_out=True).extent
    for _, frame in sorted(model.frames.items()):
        pose, directions = np.eye(4), rng.normal(size=(2, 3))
        pose[:3] = frame.rig_from_world.matrix()
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        twist = np.concatenate([np.radians(degrees) * directions[0], percent / 100 * directions[1]])
        frame.rig_from_world = pycolmap.Rigid3d(moved_pose(pose, twist, extent)[:3])
    (out / "sparse" / "0").mkdir(parents=True)
    (out / "images").symlink_to((scene / "images").resolve())
    model.write_binary(str(out / "sparse" / "0"))
    return out


def main() -> None:
    """Write a scene with moved poses, as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help="a COLMAP scene")
    parser.add_argument("out", type=Path, help="new folder for the scene")
    parser.add_argument("--degrees", type=float, default=1, help="of the turns (default: 1)")
    parser.add_argument("--percent", type=float, default=2, help="of the extent, of the moves (default: 2)")
    parser.add_argument("--seed", type=int, default=0, help="of the directions (default: 0)")
    args = parser.parse_args()
    if not (args.scene / "sparse" / "0").is_dir():
        raise UserError(f"{args.scene} is no COLMAP scene with a folder sparse/0; name one")
    if args.out.exists():
        raise UserError(f"{args.out} exists; name a new folder")
    disturb_poses(args.scene, args.out, args.degrees, args.percent, args.seed)


if __name__ == "__main__":
    run_cli(main)
