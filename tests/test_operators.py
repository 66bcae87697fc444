"""Errors of compiled operators: torch's stable interface has one type for all, and the packages raise what is meant."""

import importlib.util
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import torch
from diff_gaussian_rasterization.backend import OPERATORS
from fused_ssim.backend import OPERATORS as SSIM

RAW = torch.ops.diff_gaussian_rasterization
HUGE = 1 << 24
TORCH = tuple(int(part) for part in torch.__version__.split(".")[:2])


@pytest.mark.parametrize(("splats", "error"), [(None, TypeError), (torch.eye(4), ValueError)])
def test_a_message_names_the_error_that_is_raised(splats, error):
    arguments = splats, *[torch.zeros(1)] * 3
    with pytest.raises(RuntimeError, match=f"^{error.__name__}: splats must be") as raw:
        RAW.decisive(*arguments)
    with pytest.raises(error) as meant:
        OPERATORS.decisive(*arguments)
    assert f"{error.__name__}: {meant.value}" == str(raw.value)


def test_other_errors_stay_as_they_are():
    with pytest.raises(RuntimeError, match="^the background must be 3 float32, got "):
        SSIM.composite(torch.zeros(4, 2, 2, dtype=torch.uint8), torch.zeros(4))
    with pytest.raises(RuntimeError, match="expected at most 2"):  # torch's own
        SSIM.composite(*[torch.zeros(3)] * 3)


@pytest.mark.skipif(TORCH < (2, 13), reason="torch before 2.13 does not tell")
def test_too_little_memory_has_the_type_that_torch_has_for_it():
    one = torch.zeros(1)
    image = one.expand(HUGE, HUGE), one.expand(HUGE, HUGE)  # two PiB, of which four bytes are there
    with pytest.raises(torch.OutOfMemoryError, match="allocate"):
        SSIM.photometric(*image, 0.2, False)


@pytest.mark.skipif(shutil.which("nm") is None, reason="needs nm of the binary utilities")
@pytest.mark.parametrize("package", ["diff_gaussian_rasterization", "fused_ssim", "simple_knn"])
def test_a_library_uses_torch_through_its_stable_interface_alone(package):
    library = Path(importlib.util.find_spec(package).origin).with_name("_backend.so")
    symbols = subprocess.run(["nm", "-D", str(library)], capture_output=True, text=True, check=True).stdout
    names = [line.split()[-1].partition("@")[0] for line in symbols.splitlines()]
    assert "torch_library_impl" in names
    forbidden = re.compile(r"_Z.*N[VK]*(3c10|2at|5torch|8pybind11)\d|_?Py[A-Z_]")
    assert [name for name in names if forbidden.match(name)] == []
