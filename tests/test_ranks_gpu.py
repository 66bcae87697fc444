"""Trainings by two ranks with a GPU each, by NCCL: the bytes of one GPU, and one end for all after a fault."""

import time
from pathlib import Path

import pytest
import torch
from launching import launch, launch_fault
from trainings import whole_result

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(torch.cuda.device_count() < 2, reason="torch finds fewer than two NVIDIA GPUs"),
]

LONG = (
    *("--eval", "--iterations", "300", "--checkpoint_iterations", "150", "--save_iterations", "150", "-r", "2"),
    *("--densify_from_iter", "20", "--densification_interval", "40", "--densify_until_iter", "260"),
    *("--opacity_reset_interval", "130", "--densify_grad_threshold", "0.0004", "--random_background"),
)


def _train(scene: Path, folder: Path, size: int, *options: str, fault: str = "none 0 0") -> list[object]:
    """Train; what a checkpoint holds, and the last model."""
    name = fault.split()[0] + str(size)
    out = folder / name
    done = launch(folder / f"logs_{name}", fault, "-s", str(scene), "-m", str(out), *LONG, *options, size=size)
    assert done.status == 0, done.stderr
    return [whole_result(out, 150), (out / "point_cloud/iteration_300/point_cloud.ply").read_bytes()]


@pytest.mark.parametrize("options", [(), ("--strategy", "mcmc", "--max_num_splats", "400", "--train_test_exp")])
def test_two_gpus_write_the_bytes_of_one(colmap_scene, tmp_path, options):
    assert _train(colmap_scene, tmp_path, 1, *options) == _train(colmap_scene, tmp_path, 2, *options)


@pytest.mark.parametrize("fault", ["kill 1 7", "hang 1 7", "memory 1 7", "overflow 1 7"])
def test_a_fault_of_one_rank_ends_both(colmap_scene, tmp_path, fault):
    began = time.monotonic()
    done = launch_fault(colmap_scene, tmp_path, fault, "--iterations", "40")
    assert time.monotonic() - began < 90  # torchrun kills a rank that does not end 30 seconds after a signal
    assert done.status != 0
    names = {path.name for path in (tmp_path / "out").glob("chkpnt*.pth")}
    assert names == ({"chkpnt5.pth", "chkpnt7.pth"} if fault.startswith("overflow") else {"chkpnt5.pth"})
    assert not list((tmp_path / "out").rglob("*.tmp*"))


def test_a_signal_to_one_rank_stops_both_with_a_checkpoint(colmap_scene, tmp_path):
    done = launch_fault(colmap_scene, tmp_path, "interrupt 1 7")
    assert done.status != 0 and done.errors == [] and "".join(done.stderr).count("interrupted") == 1
    assert {path.name for path in (tmp_path / "out").glob("chkpnt*.pth")} == {"chkpnt5.pth", "chkpnt8.pth"}
