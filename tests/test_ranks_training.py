"""A training over ranks: few words between them (tests/test_training_bytes.py: the bytes of one process)."""

import sys
from collections import Counter

import pytest
import torch
from processes import in_ranks

import train
from splatting.distributed import process_group
from splatting.training.iteration import Iteration
from splatting.training.steps.fused import FusedStep

COLLECTIVES = ("all_gather", process_group.ALL_GATHER, "all_gather_object", "all_reduce", "all_to_all_single",
               "barrier", "broadcast", "broadcast_object_list")  # fmt: skip
# What a step costs that changes no rows. Each call waits for the slowest rank: add none without need.
STEP = {
    process_group.ALL_GATHER: 1,  # numbers of splats that each rank sends, with signals and flags
    "all_reduce": 1,  # sums of the loss
    # Splats in four, which follow each other; rows around a band; numbers of gradient rows of each splat, the rows.
    "all_to_all_single": 7,
    "broadcast": 1,  # the photo
}
# the image in place of the rows around a band
WHOLE_STEP = {process_group.ALL_GATHER: 1, "all_to_all_single": 7, "broadcast": 1}
FIRST = "broadcast_object_list"  # once for each photo: its shape


def _train(scene: str, out: str, options: list[str]) -> list[dict[str, int]]:
    """Train: the collective calls of steps that change no rows."""
    torch.set_num_threads(1)
    calls, counted = Counter(), []
    measure, advance = FusedStep.measure, FusedStep.advance

    def counting(name: str) -> None:
        call = getattr(process_group.dist, name)

        def counted_call(*args: object, **kwargs: object) -> object:
            calls[name] += 1
            return call(*args, **kwargs)

        setattr(process_group.dist, name, counted_call)

    def measured(self: FusedStep, step: object) -> tuple:
        calls.clear()
        return measure(self, step)

    def advanced(self: FusedStep, at: Iteration, *args: object) -> None:
        advance(self, at, *args)
        counted.extend([] if at.changes or at.last else [dict(calls)])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdout", sys.stdout)  # training stamps it
        patch.setattr(FusedStep, "measure", measured)
        patch.setattr(FusedStep, "advance", advanced)
        for name in COLLECTIVES:
            patch.setattr(process_group.dist, name, getattr(process_group.dist, name))  # so that it is undone
            counting(name)
        words = ["-s", scene, "-m", out, "--iterations", "30", "--no_curve", "--disable_viewer", "--quiet"]
        density = ["--densify_from_iter", "5", "--densification_interval", "10", "--densify_grad_threshold", "5e-5"]
        train.main([*words, *density, "--test_iterations", "-1", *options])
    return counted


@pytest.mark.parametrize(
    ("size", "options", "cost"),
    [
        (3, ["-r", "96", "--strategy", "adc"], STEP),
        (2, ["-r", "50", "--eval", "--train_test_exp"], WHOLE_STEP),  # exposures need the whole image
        (2, ["-r", "50", "--eval", "--refine_poses"], STEP | {"all_to_all_single": 8}),  # sums of the pose's gradient
    ],
)
def test_a_step_takes_few_collective_calls(colmap_scene, tmp_path, size, options, cost):
    for calls in in_ranks(size, _train, str(colmap_scene), str(tmp_path / "model"), options):
        assert 10 < sum(each.pop(FIRST, 0) for each in calls) <= 20
        found_bands = cost | {process_group.ALL_GATHER: 2}
        assert 10 < sum(each == found_bands for each in calls) <= 20  # at a view's first visit
        assert len(calls) > 20 and all(each in (cost, found_bands) for each in calls), calls
