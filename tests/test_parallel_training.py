"""Batches of views (--parallel views): an iteration shows one for each rank."""

from pathlib import Path

import torch
from gaussians import options
from processes import in_ranks
from test_masks import masked_scene  # noqa: F401  (a fixture)
from trainings import train_on

from scene.gaussians.density_rules import actions
from splatting.training.iteration import ViewOrder
from splatting.training.schedule import BatchSchedule
from utils.system_utils import UserError

SHORT = (
    *("--iterations", 60, "--densify_until_iter", 55, "--save_iterations", -1, "--test_iterations", -1, "--eval"),
    *("--densify_from_iter", 5, "--densification_interval", 20),
)


def _batches(scene: Path, folder: Path, *options: object) -> dict[int, bytes] | str:
    """PLYs by iteration, or the reason why the training is refused."""
    torch.set_num_threads(1)
    views = "--checkpoint_iterations", 30, "--parallel", "views", "--disable_viewer", "--quiet"
    try:
        return train_on(scene, folder, *SHORT, *views, *options)
    except UserError as error:
        return str(error)


def test_batches_of_views_can_be_resumed_by_as_many_ranks(masked_scene, tmp_path):  # noqa: F811
    options = "--random_background", "--refine_poses"
    whole = in_ranks(2, _batches, masked_scene, tmp_path / "a", *options)[0]
    assert whole.keys() == {30}  # of 60 views
    resume = (*options, "--start_checkpoint", tmp_path / "a" / "chkpnt15.pth")
    assert in_ranks(2, _batches, masked_scene, tmp_path / "b", *resume)[0] == whole
    assert (tmp_path / "a" / "poses.json").read_bytes() == (tmp_path / "b" / "poses.json").read_bytes()
    refused = in_ranks(1, _batches, masked_scene, tmp_path / "c", *resume)[0]
    assert "had 2 views in each iteration, and this one would have 1" in refused


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
