"""Trainings on disturbed poses, without and with --refine_poses: scores, errors of poses, and these against seconds.

    python -m benchmarks.scenes.poses SCENE OUT --degrees 0 0.1 0.3 1 --percent 0 0.2 0.5 2 --seeds 0 1 2

SCENE is a COLMAP scene, whose poses count as right. Each camera turns by so many degrees about a random axis, and its
centre moves by so many percent of the extent in a random direction; points and tracks stay. Other options go to
train.py. Errors of poses are means in degrees and percent.
"""

import argparse
from pathlib import Path

import numpy as np

from benchmarks.harness.measuring import describe, print_table
from benchmarks.scenes.training import train
from scene.dataset_readers import SceneInfo, read_scene
from scene.gaussian_model import GaussianModel
from scene.gaussians.checkpoint import POSES, further, load_checkpoint
from scene.pose_file import with_poses
from scene.reprojection import moved_pose
from scene.scene import Scene
from splatting.files.json_files import read_json
from splatting.training.pose_refinement import PoseRefinement
from utils.graphics_utils import camera_center
from utils.system_utils import UserError, compute_device, run_cli

LOOKS = (0.1, 0.25, 0.5, 0.75, 1.0)  # parts of the iterations, after which errors of poses are noted


def disturbed(scene: Path, out: Path, degrees: float, percent: float, seed: int) -> Path:
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


def errors(found: list, right: SceneInfo) -> list[float]:
    """Mean angle (degrees) and distance (percent of the extent) between poses and those of the views of their names."""
    views = {view.image_name: view for view in right.train_cameras + right.test_cameras}
    apart = []
    for one in found:
        other = views[one.image_name]
        chord = np.linalg.norm(one.R - other.R) / np.sqrt(8)
        moved = camera_center(one.R, one.T) - camera_center(other.R, other.T)
        apart.append([np.degrees(2 * np.arcsin(min(chord, 1))), 100 * np.linalg.norm(moved) / right.extent])
    return np.mean(apart, axis=0).tolist()


def course(scene: Path, model: Path, right: SceneInfo) -> list[list[float]]:
    """Seconds of training, and the errors of the training views' poses, at the start and at each checkpoint."""
    fixed = {"images": "images", "resolution": -1, "eval": True, "white_background": False, "train_test_exp": False}
    names = {"source_path": str(scene), "model_path": str(model), "data_device": "cpu"}
    shown = Scene(argparse.Namespace(**fixed, **names), GaussianModel(0), start=False)
    poses, views = PoseRefinement(shown, str(scene), 1), shown.getTrainCameras()
    seconds = {record["iteration"]: record["seconds"] for record in read_json(model / "train_log.json")}
    rows = [[0.0, *errors(views, right)]]
    for path in sorted(model.glob("chkpnt*.pth"), key=lambda path: int(path.stem[6:])):
        state, iteration = load_checkpoint(str(path), "cpu")
        poses.restore(further(state, POSES))
        rows.append([seconds[iteration], *errors(views, right)])
    return rows


def compare(
    scene: Path, out: Path, size: tuple[float, float], seed: int, options: list[str], looks: list[str]
) -> list[float]:
    """Train without and with refined poses, and print what came of it; both PSNR (dB)."""
    folder, right = disturbed(scene, out / "scene", *size, seed), read_scene(scene, "images", hold_out=True)
    given = read_scene(folder, "images", hold_out=True)
    rows, scores = [], []
    for name, more in (("given", []), ("refined", ["--refine_poses", "--checkpoint_iterations", *looks])):
        run = train(folder, out / name, seed, [*options, *more])
        found = with_poses(given, out / name) if more else given
        both = errors(found.train_cameras, right), errors(found.test_cameras, right)
        cells = [f"{turn:.3f} deg {shift:.3f} %" for turn, shift in both]
        scores.append(run["PSNR"])
        rows.append([name, f"{run['PSNR']:.2f}", f"{run['SSIM']:.4f}", *cells, f"{run['seconds']:.1f}"])
    print(f"\n{size[0]:g} degrees, {size[1]:g} % of the extent, seed {seed}")
    print_table(["poses", "PSNR dB", "SSIM", "training views off by", "test views off by", "training s"], rows)
    cells = [[f"{at:.1f}", f"{turn:.4f}", f"{shift:.4f}"] for at, turn, shift in course(folder, out / "refined", right)]
    print_table(["s", "training views off by degrees", "% of the extent"], cells)
    return scores


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help="a COLMAP scene")
    parser.add_argument("out", type=Path, help="new folder for scenes and models")
    parser.add_argument(
        "--degrees", type=float, nargs="+", default=[0, 0.1, 0.3, 1], help="turns (default: 0 0.1 0.3 1)"
    )
    parser.add_argument("--percent", type=float, nargs="+", default=[0, 0.2, 0.5, 2], help="moves, one for each turn")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="one run of each kind for each")
    parser.add_argument("--iterations", type=int, default=7000, help="of each training (default: 7000)")
    args, options = parser.parse_known_args()
    if not (args.scene / "sparse" / "0").is_dir():
        raise UserError(f"{args.scene} is no COLMAP scene with a folder sparse/0; name one")
    if args.out.exists():
        raise UserError(f"{args.out} exists; name a new folder")
    if len(args.degrees) != len(args.percent):
        raise UserError("give as many --percent as --degrees")
    print(describe(compute_device()))
    looks = [str(round(part * args.iterations)) for part in LOOKS]
    rows = []
    for size in zip(args.degrees, args.percent, strict=True):
        scores = []
        for seed in args.seeds:
            out = args.out.resolve() / f"{size[0]:g}_{size[1]:g}_{seed}"
            words = ["--iterations", str(args.iterations), *options]
            scores.append(compare(args.scene.resolve(), out, size, seed, words, looks))
        rows.append([*map(str, size), *(f"{mean:.2f}" for mean in np.mean(scores, axis=0))])
    print(f"\nmeans over {len(args.seeds)} seeds")
    print_table(["degrees", "% of the extent", "given: PSNR dB", "refined"], rows)


if __name__ == "__main__":
    run_cli(main)
