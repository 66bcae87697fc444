"""Trainings by train.py in the process of a test, and what they leave."""

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from synthetic import FOCAL, make_colmap_scene

import train
from scene import sleeping
from scene.readers.point_cloud import write_point_cloud
from scene.sleeping import Sleeping
from splatting import loop, run
from splatting.faster import FasterSteps
from splatting.features import robust_mask_residuals as residuals
from splatting.features import sky_shell
from splatting.iteration import Iteration

Once = Callable[[str, Callable[[Path], object]], Path]
ITERATIONS = 60
EDGES = 19, 20, 29, 30, 33, 42, 59  # before and after changes of rows, a reset, and rests; before the last iteration
LOOKS = ("--test_iterations", 3, 17, 31, 45, "--save_iterations", 9, 44)  # and checkpoints, between
LOOKS += "--checkpoint_iterations", *EDGES, ITERATIONS
LEARNT = "poses.json", "exposure.json", "appearance.json"
MCMC = ("--strategy", "mcmc", "--mcmc_noise", 5e4, "--mcmc_init_opacity", 0.03, "--mcmc_min_opacity", 0.024)
PYRAMID = "--schedule", Path(__file__).parent / "pyramid_60.json"  # small views at first
BUDGET = ("--strategy", "budget", "--max_num_splats", 500, "--densify_until_iter", 50)
OPTIONS = {
    "default": (),
    "sparse": ("--optimizer_type", "sparse_adam", "--random_background"),
    "exposure": ("--train_test_exp", "--antialiasing"),
    "appearance": ("--appearance", "ppisp", "--antialiasing"),
    "depth": ("-d", "depths", "--depth_l1_weight_init", 1.0),
    "points": ("--sparse_depth", 0.5, "--masks", "masks", *PYRAMID),
    "degree 0": ("--sh_degree", 0),
    "rays": ("--projection", "ray"),
    "absgrad": ("--absgrad", "--absgrad_threshold", 2e-4, "--max_num_splats", 400),
    "two phases": ("--densify_until_iter", 30),  # so that two phases have steps to capture
    "tiny": ("-r", 8),  # images of one tile
    "together": (  # rows and opacities change in the same iterations
        *("--opacity_reset_interval", 20, "-w", "--absgrad", "--absgrad_threshold", 2e-4, "--train_test_exp"),
        *("-d", "depths", "--depth_l1_weight_init", 1.0, "--masks", "masks"),
    ),
    "mcmc": MCMC,
    "mcmc idle": ("--strategy", "mcmc", "--mcmc_growth", 0, "--mcmc_min_opacity", 1e-6),
    "mcmc sparse": (*MCMC, "--optimizer_type", "sparse_adam", "--antialiasing"),
    "budget": BUDGET,
    "sky": ("--sky", "auto", "--densify_grad_threshold", 1e-5),
    "robust mask": ("--robust_mask", 0.3, "--opacity_reset_interval", 3000),
    "points and poses": ("--sparse_depth", 0.5, "--refine_poses"),
    "poses": ("--refine_poses", *PYRAMID),
    "poses, no graph": ("--refine_poses", "--train_test_exp", "-d", "depths", "--depth_l1_weight_init", 1),
    "exposure and sizes": ("--train_test_exp", *PYRAMID, "-r", 1),
    "budget errors": (*BUDGET, "--train_test_exp"),
}
ASLEEP = "default", "poses", "together", "budget", "degree 0", "rays"
OPTIONS |= {f"asleep, {name}": OPTIONS[name] for name in ASLEEP}  # whose blocks sleep: see trained_as

PART_OPTIONS = {  # that begin with something of a checkpoint, or of the scene
    "time_budget": PYRAMID,
    "exposure": ("--train_test_exp",),
    "refine_poses": ("--refine_poses",),
    "depths": ("-d", "depths", "--depth_l1_weight_init", 1.0),
    "robust_mask": ("--robust_mask", 0.3),
    "adc": ("--strategy", "adc", "--absgrad", "--absgrad_threshold", 2e-4, "--max_num_splats", 400),
    "mcmc": MCMC,
    "budget": BUDGET,
    "sky": ("--sky", "auto"),
    "sparse_depth": ("--sparse_depth", 0.5),
    "ppisp": ("--appearance", "ppisp"),
}


def narrow_scene(folder: Path, model: str = "PINHOLE", distortion: tuple[float, ...] = ()) -> Path:
    """Make a COLMAP scene of which a view sees a part, with a mask and an inverse depth map for each photo."""
    make_colmap_scene(folder, model=model, params=(5 * FOCAL, 5 * FOCAL, 48.0, 32.0, *distortion))
    images = folder / "images"
    photos = [photo.relative_to(images) for photo in images.rglob("*") if photo.is_file()]
    mask = np.full((64, 96), 255, np.uint8)
    mask[:, :20] = 0
    depth = np.linspace(0, 2**15, 64 * 96).astype(np.uint16).reshape(64, 96)
    for photo in photos:
        for pixels, path in ((mask, f"masks/{photo}.png"), (depth, f"depths/{photo.with_suffix('.png')}")):
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(pixels).save(folder / path)
    scales = {str(photo.with_suffix("")): {"scale": 1.0, "offset": 0.0} for photo in photos}
    (folder / "sparse/0/depth_params.json").write_text(json.dumps(scales))
    return folder


def with_clusters(scene: Path, near: int, clusters: int, each: int) -> Path:
    """Give a scene `near` points in the middle, and clusters of `each` points, of which a view sees a part."""
    rng = np.random.default_rng(0)
    centers = np.repeat(rng.uniform(-8, 8, (clusters, 3)), each, 0)
    points = np.concatenate((0.5 * rng.normal(size=(near, 3)), centers + 0.1 * rng.normal(size=centers.shape)))
    write_point_cloud(scene / "points.ply", points, rng.integers(0, 255, points.shape))
    return scene


def train_on(scene: Path, out: Path, *words: object) -> dict[int, bytes]:
    """Train; the PLYs in the output folder by iteration."""
    train.main([*map(str, ("-s", scene, "-m", out, *words))])
    return saved_plys(out)


def saved_plys(out: Path) -> dict[int, bytes]:
    """The PLYs in an output folder by iteration."""
    return {int(ply.parent.name[10:]): ply.read_bytes() for ply in out.glob("point_cloud/*/*.ply")}


def trained(scene: Path, out: Path, *options: object) -> dict[str, bytes | list]:
    """Train for 60 iterations, in which rows and the SH degree change; see whole_result."""
    words = ["--eval", "-r", 48, "--iterations", ITERATIONS, "--densify_from_iter", 10, "--densification_interval", 20]
    words += ["--opacity_reset_interval", 30, "--test_iterations", -1, "--checkpoint_iterations", ITERATIONS]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdout", sys.stdout)  # training stamps it
        patch.setattr(run, "SH_INTERVAL", 12)  # between the iterations that change rows
        patch.setattr(residuals.Residuals, "early", 0)  # renders are far from the photos
        patch.setattr(residuals, "_FACTOR", 1.2)
        patch.setattr(residuals, "_BESIDE", 0.4)
        patch.setattr(sky_shell, "FEWEST", -1)  # --sky adds one in any scene
        train_on(scene, out, *words, "--no_curve", "--quiet", "--disable_viewer", *options)
    return whole_result(out, ITERATIONS)


@contextmanager
def sleep(most_share: float) -> Iterator[list[float]]:
    """Let blocks sleep where views see no more of the points, and rest every 7 iterations.

    Yields a list that gets the share that is awake, step by step.
    """
    shares, wake = [], Sleeping.wake

    def noted(self: Sleeping, *arguments: object) -> torch.Tensor:
        awake = wake(self, *arguments)
        shares.append(float(self.awake.float().mean()))
        return awake

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sleeping, "REST", 7)
        patch.setattr(sleeping, "MOST_SHARE", most_share)
        patch.setattr(Sleeping, "wake", noted)
        yield shares


def trained_as(name: str, scene: Path, out: Path, *more: object) -> dict[str, bytes | list]:
    """`trained` on shared_scene with the options of a name: from clusters of which most sleep, or with none asleep."""
    asleep = name.startswith("asleep")
    points = ("--init_pcd_path", scene / "points.ply") if asleep else ()
    with sleep(2.0 if asleep else 0.0) as shares:
        result = trained(scene, out, *OPTIONS[name], *points, *more)
    if asleep and "--start_checkpoint" not in more:
        assert (min(shares) < 0.9) == ("rays" not in name)  # every view wakes all for these
    return result


def shared_scene(once: Once) -> Path:
    """A scene of narrow_scene with clusters, made for all workers; see conftest.once."""
    return once("narrow_scene", lambda folder: with_clusters(narrow_scene(folder), 1000, 30, 200))


def plain_training(once: Once, name: str) -> Path:
    """The output folder of trained_as by plain steps, with LOOKS, for all workers."""
    words = "--plain_step", *LOOKS
    if name == "asleep, degree 0":  # a checkpoint while blocks sleep gives f_rest, which has no values, a state of none
        words = words[:1]
    return once(f"plain/{name}", lambda out: trained_as(name, shared_scene(once), out, *words))


def before_steps(monkeypatch: pytest.MonkeyPatch, act: Callable[[Iteration], None]) -> None:
    """Let act(step) be called before each step of a training is taken."""
    chosen = loop.faster_steps

    def taker(of: run.Run) -> FasterSteps:
        taken = chosen(of)
        take = taken.take
        taken.take = lambda step, tell: (act(step), take(step, tell))[1]
        return taken

    monkeypatch.setattr(loop, "faster_steps", taker)


def leaves(value: object) -> list:
    """The numbers of a checkpoint, one after the other; tensors as shape and bytes."""
    if torch.is_tensor(value):
        return [(value.shape, value.detach().cpu().numpy().tobytes())]
    if isinstance(value, dict):
        return [leaf for pair in value.items() for leaf in (pair[0], *leaves(pair[1]))]
    if isinstance(value, list | tuple):
        return [leaf for item in value for leaf in leaves(item)]
    return [value]


def whole_result(out: Path, iteration: int) -> dict[str, bytes | list]:
    """The bytes of the PLY of an iteration and of what was learnt beside it, and the leaves of its checkpoint."""
    checkpoint = torch.load(out / f"chkpnt{iteration}.pth", "cpu", weights_only=False)  # where all has room
    ply = out / f"point_cloud/iteration_{iteration}/point_cloud.ply"
    beside = {path.name: path.read_bytes() for name in LEARNT if (path := out / name).exists()}
    return {"ply": ply.read_bytes(), **beside, "checkpoint": leaves(checkpoint)}


def differences(one: dict[str, bytes | list], other: dict[str, bytes | list]) -> list[str]:
    """Describe the differences between two results, in few words."""
    pairs = zip(one["checkpoint"], other["checkpoint"], strict=True)
    found = [f"leaf {n}: {str(a)[:60]} and {str(b)[:60]}" for n, (a, b) in enumerate(pairs) if a != b]
    files = sorted({*one, *other} - {"checkpoint"})
    return found + [name for name in files if one.get(name) != other.get(name)]
