"""Too little memory: the warning beforehand, the files saved when memory runs out, and the message."""

import re
from itertools import chain, repeat
from pathlib import Path
from unittest.mock import DEFAULT, Mock

import pytest
import torch
from gaussians import model, needs_59_values, options

import train
from groundwork.host import memory
from groundwork.host.memory import free_memory, gib, is_out_of_memory
from scene.images import decode
from splatting import loop, resources
from splatting.resources import training_bytes
from utils.system_utils import UserError

ROOT = Path(__file__).parents[1]
HUGE = 1 << 60
# torch's message on a full GPU.
ON_A_GPU = torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB. GPU 0 has a total capacity of ...")


def _raised(call) -> Exception:
    try:
        call()
    except Exception as error:
        return error
    raise AssertionError("nothing was raised")


def _instances_beyond_counting() -> None:
    raise RuntimeError("5 Gaussians cover 3000000000 tile instances, more than 2^31 - 1: render at a lower resolution")


def test_which_errors_mean_too_little_memory():
    for call in (lambda: torch.empty(HUGE, dtype=torch.uint8), lambda: bytearray(HUGE), _instances_beyond_counting):
        error = _raised(call)
        assert is_out_of_memory(error), error
        wrapped = UserError("too large")
        wrapped.__cause__ = error
        assert is_out_of_memory(wrapped)
    assert is_out_of_memory(ON_A_GPU)
    others = RuntimeError("shapes differ"), ValueError("out of memory"), UserError("no"), KeyboardInterrupt(), None
    assert not any(map(is_out_of_memory, others))


def test_a_disk_without_space_is_told_before_the_training(colmap_scene, tmp_path, monkeypatch, capfd):
    words = ["-s", str(colmap_scene), "-m", str(tmp_path / "out"), "-r", "48", "--disable_viewer", "--iterations", "3"]
    words += ["--save_iterations", "2", "--test_iterations", "-1"]
    free = Mock(return_value=Mock(free=50_000))
    monkeypatch.setattr(resources, "shutil", Mock(disk_usage=free))
    said = "the disk of .*out has 0.1 MB free, and a model of 300 Gaussians takes 0.1 MB; free space there, or name"
    with pytest.raises(UserError, match=said):
        train.main(words)
    assert not (tmp_path / "out").exists()
    free.return_value.free = 100_000  # one PLY has 74,400 bytes
    train.main(words)
    told = re.findall("warning: the disk of .*", capfd.readouterr().err)
    assert [re.search("[\\d.]+ MB if there are [\\d,]+", text)[0] for text in told] == [
        "3.0 MB if there are 6,000",
        "0.1 MB if there are 300",
    ]


def test_free_memory_is_what_the_kernel_and_the_container_leave(tmp_path, monkeypatch):
    available = memory._read_available()
    if available is None:
        pytest.skip("this system has no /proc/meminfo")
    monkeypatch.setattr(memory, "_CGROUP", tmp_path)
    assert free_memory("cpu") == pytest.approx(available, rel=0.1)
    (tmp_path / "memory.max").write_text("max\n")
    assert free_memory("cpu") == pytest.approx(available, rel=0.1)
    (tmp_path / "memory.max").write_text("1000000\n")
    (tmp_path / "memory.current").write_text("900000\n")
    (tmp_path / "memory.stat").write_text("anon 5\ninactive_file 50000\n")
    assert free_memory("cpu") == 150_000
    for path in tmp_path.iterdir():
        path.unlink()
    (tmp_path / "memory").mkdir()
    (tmp_path / "memory" / "memory.limit_in_bytes").write_text("1000\n")
    (tmp_path / "memory" / "memory.usage_in_bytes").write_text("400\n")
    (tmp_path / "memory" / "memory.stat").write_text("total_inactive_file 100\n")
    assert free_memory("cpu") == 700


# Training


SMALL = [
    "-r", "24", "--test_iterations", "-1", "--iterations", "9", "--densify_from_iter", "2",
    "--densification_interval", "3", "--densify_grad_threshold", "5e-5",
]  # fmt: skip


def _train(scene: Path, out: Path, *more: object) -> bytes:
    train.main(["-s", str(scene), "-m", str(out), *SMALL, *map(str, more)])
    return (out / "point_cloud" / "iteration_9" / "point_cloud.ply").read_bytes()


def _failing(function, call: int, error: Exception):
    """Wrap `function` so that one call raises."""
    return Mock(wraps=function, side_effect=chain(repeat(DEFAULT, call - 1), [error], repeat(DEFAULT)))


def test_a_training_says_what_did_not_fit(colmap_scene, tmp_path, monkeypatch):
    """A full GPU in a step, and photos that are too large for the host."""
    said = r"training ran out of memory \(%s.* free on the CPU; 300 Gaussians; images of 24 x 16\); lower .*resume"
    for of, name, error, words in (
        (loop, "render", ON_A_GPU, "20.0 GiB asked for, "),
        (decode, "_to_rgb_or_rgba", MemoryError(), r"not enough memory for .*[vV]\d\d.png at 24 x 16 pixels"),
    ):
        with monkeypatch.context() as patch, pytest.raises(UserError, match=said % words):
            patch.setattr(of, name, _failing(getattr(of, name), 3, error))
            _train(colmap_scene, tmp_path, "--plain_step", "--images_to_load", 1)


def test_other_errors_of_a_training_stay_what_they_are(colmap_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "render", _failing(loop.render, 3, RuntimeError("shapes differ")))
    with pytest.raises(RuntimeError, match="shapes differ"):
        _train(colmap_scene, tmp_path, "--plain_step")
    assert not list(tmp_path.glob("*.pth"))


# The estimate


@needs_59_values
def test_the_estimate_and_its_warnings(colmap_scene, tmp_path, monkeypatch, capfd):
    free = 1 << 24
    monkeypatch.setattr(resources, "free_memory", lambda _: free)
    at_start = 300 * (4 * (3 * 59 + 45) + resources.PER_GAUSSIAN) + 24 * 16 * resources.PER_PIXEL
    pictures, many = 17 * 4 * 24 * 16, ("--max_num_splats", 2_000_000_000)

    def said(*more: object) -> tuple[str, str]:
        _train(colmap_scene, tmp_path, *more)
        out, err = capfd.readouterr()
        lines = re.findall("^CPU memory: about .*$", out, re.MULTILINE)
        return "".join(lines), "\n".join(re.findall("^warning: the memory.*$", err, re.MULTILINE))

    line, warning = said()
    assert "of 0.02 GiB: photos 0.00 GiB, 6,000 Gaussians (scenes often grow 20-fold) 0.01 GiB" in line and not warning
    assert f"2,000,000,000 Gaussians (--max_num_splats) {gib(2e9 * 1039)}" in said("--absgrad", *many)[0]
    assert "photos 0.00 GiB (--images_to_load keeps 5 of 17 decoded images), " in said("--images_to_load", 5)[0]
    line, warning = said(*many)
    assert f"2,000,000,000 Gaussians (--max_num_splats) {gib(2e9 * 1014)}" in line  # 25 bytes less of each
    assert "too small for 2,000,000,000 Gaussians; set a lower --max_num_splats" in warning
    free = pictures + at_start
    assert "6,000 Gaussians" in said()[1] and not said("--max_num_splats", 300)[1]
    with monkeypatch.context() as patch:
        patch.setattr(resources, "local_size", lambda: 2)  # processes that share what is free
        line, warning = said("--max_num_splats", 300)
    assert f"of {gib(free // 2)}" in line and "for 300 Gaussians; set --images_to_load" in warning
    free = 1 << 40
    assert said() == ("", "")  # nobody has to know


def test_the_estimate_counts_what_training_keeps():
    """The estimate of parameters, moments and a copy of the largest equals torch's own count of the tensors."""
    gaussians = model(50)
    gaussians.training_setup(options())
    tensors = [group["params"][0] for group in gaussians.optimizer.param_groups]
    for parameter in [*tensors]:
        gaussians.optimizer.state_of(parameter)
    tensors.append(max(tensors, key=torch.numel))
    tensors += [value for state in gaussians.optimizer.state.values() for value in state.values() if value.dim()]
    counted = sum(tensor.untyped_storage().nbytes() for tensor in tensors)
    assert training_bytes(gaussians, 50, 0) - 50 * resources.PER_GAUSSIAN == counted
    more = training_bytes(gaussians, 50, 0, absolute=True) - training_bytes(gaussians, 50, 0)
    assert more == 50 * resources.PER_ABSOLUTE >= 50 * (4 + 8)  # a length, and a row of two values at least
