"""Trainings by several ranks: the files of one process, to the byte, and batches of views."""

import csv
import hashlib
from pathlib import Path

import torch
from gaussians import options
from processes import in_ranks
from test_masks import masked_scene  # noqa: F401  (a fixture)

import train
from scene.gaussians.density_rules import actions
from splatting.distributed.ranks import ranks
from splatting.training.iteration import ViewOrder
from splatting.training.schedule import BatchSchedule
from utils.system_utils import UserError

EVERYTHING = (
    *("--eval", "--iterations", 200, "--checkpoint_iterations", 100, "--save_iterations", 100, "--random_background"),
    *("--densify_from_iter", 20, "--densification_interval", 40, "--densify_until_iter", 190, "-r", 2),
    *("--opacity_reset_interval", 85, "--test_iterations", -1, "--densify_grad_threshold", 0.0004),
)
LAST = "point_cloud/iteration_200/point_cloud.ply"
SHORT = (
    *("--iterations", 60, "--densify_until_iter", 55, "--save_iterations", -1, "--test_iterations", -1, "--eval"),
    *("--densify_from_iter", 5, "--densification_interval", 20),
)


def _train(scene: Path, folder: Path, *options: object) -> dict[str, str]:
    """Train, and return digests of what is written."""
    train.main(["-s", str(scene), "-m", str(folder), *map(str, options), "--disable_viewer", "--quiet"])
    return _digests(folder) if ranks().first else {}


def _digests(folder: Path) -> dict[str, str]:
    found = {}
    for path in sorted(folder.rglob("*.p*")):
        if path.suffix in (".ply", ".pth"):
            found[str(path.relative_to(folder))] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def _curve(folder: Path) -> dict[str, dict[str, str]]:
    """Points of the curve by iteration, without seconds and memory. How many there are depends on the seconds."""
    with (folder / "error_vs_time.csv").open() as file:
        rows = list(csv.DictReader(file))
    kept = [name for name in rows[0] if "seconds" not in name and "memory" not in name]
    return {row["iteration"]: {name: row[name] for name in kept} for row in rows}


def _assert_same_curves(one: dict, other: dict) -> None:
    both = one.keys() & other.keys()
    assert {"200"} < both and len(both) > 4
    assert [one[iteration] for iteration in both] == [other[iteration] for iteration in both]


def _whole(scene: Path, folder: Path, *options: object) -> dict[str, str]:
    torch.set_num_threads(1)
    return _train(scene, folder / str(ranks().size), *EVERYTHING, *options)


def test_ranks_write_the_files_of_one_process(masked_scene, tmp_path):  # noqa: F811
    """The checkpoints' bytes and the points of the curve, too; a checkpoint is resumed by any number of ranks."""
    one, two = (in_ranks(size, _whole, masked_scene, tmp_path)[0] for size in (1, 2))
    assert one == two and {"chkpnt100.pth", LAST} < one.keys()
    start = "--start_checkpoint", tmp_path / "2" / "chkpnt100.pth"
    folders = [tmp_path / "1", tmp_path / "2"]
    for size in (1, 3):
        folders.append(tmp_path / "resumed" / str(size))
        assert in_ranks(size, _whole, masked_scene, tmp_path / "resumed", *start)[0][LAST] == two[LAST]
    for folder in folders[1:]:
        _assert_same_curves(_curve(folders[0]), _curve(folder))


def _batches(scene: Path, folder: Path, *options: object) -> dict[str, str]:
    torch.set_num_threads(1)
    try:
        return _train(scene, folder, *SHORT, "--checkpoint_iterations", 30, "--parallel", "views", *options)
    except UserError as error:
        return {"error": str(error)}


def test_batches_of_views_can_be_resumed_by_as_many_ranks(masked_scene, tmp_path):  # noqa: F811
    whole = in_ranks(2, _batches, masked_scene, tmp_path / "a", "--random_background")[0]
    last = "point_cloud/iteration_30/point_cloud.ply"  # 60 views
    assert whole.keys() >= {"chkpnt15.pth", last}
    resume = ("--random_background", "--start_checkpoint", tmp_path / "a" / "chkpnt15.pth")
    assert in_ranks(2, _batches, masked_scene, tmp_path / "b", *resume)[0][last] == whole[last]
    refused = in_ranks(1, _batches, masked_scene, tmp_path / "c", *resume)[0]
    assert "had 2 views in each iteration, and this one would have 1" in refused["error"]


def test_a_batch_goes_through_the_schedule_by_views():
    pace = BatchSchedule(30_000, 4)
    assert pace.ends == 7500 and pace.schedule_step(7500) == 30_000 and list(pace.span(2)) == [5, 6, 7, 8]
    assert pace.rate_factor(1) == 2.0 and pace.known([7000, 30_000, 40_000]) == [1750, 7500]
    assert BatchSchedule(10, 4).ends == 3 and list(BatchSchedule(10, 4).span(3)) == [9, 10]
    opt = options(densify_until_iter=15_000)
    found = [t for t in range(1, 7501) if actions(t, opt, False, pace.span(t), 4.0, 4).densify]
    assert found[:2] == [150, 175] and found[-1] == 3725  # every 100 views
    resets = [t for t in range(1, 7501) if actions(t, opt, False, pace.span(t), 4.0, 4).reset_opacity]
    assert resets == [750, 1500, 2250, 3000]


def test_the_views_of_a_batch_follow_each_other():
    cameras = list("abcdefg")
    one = ViewOrder(cameras, 3)
    ranks_views = [ViewOrder(cameras, 3, 2, place) for place in (0, 1)]
    shown = [order[t] for t in range(1, 11) for order in ranks_views]
    assert shown == [one[t] for t in range(1, 21)]
    assert [ranks_views[0].of(n) for n in ranks_views[0].numbers(4)] == [one[7], one[8]]
