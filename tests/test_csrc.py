"""The extensions: who may include what, and what the libraries take from torch."""

import importlib.util
import re
import shutil
import subprocess
from pathlib import Path

import diff_gaussian_rasterization  # noqa: F401  (loads the library with the operators)
import pytest

ROOT = Path(__file__).parents[1]
CSRC = sorted((ROOT / "submodules").glob("*/csrc"))
PACKAGES = ("diff_gaussian_rasterization", "fused_ssim", "simple_knn")
SUFFIXES = {".cpp", ".cu", ".cuh", ".h"}


def includes(folder: Path) -> list[tuple[Path, str]]:
    files = [path for path in sorted(folder.rglob("*")) if path.suffix in SUFFIXES]
    return [(path, name) for path in files for name in re.findall(r'^#include [<"](.*?)[>"]', path.read_text(), re.M)]


@pytest.mark.parametrize("csrc", CSRC, ids=[csrc.parent.name for csrc in CSRC])
def test_only_the_torch_folder_sees_torch(csrc):
    seeing = {path for path, name in includes(csrc) if re.match(r"(torch|ATen|c10)/|gs/torch_", name)}
    assert seeing and {path.parent.name for path in seeing} == {"torch"}


@pytest.mark.parametrize("csrc", CSRC, ids=[csrc.parent.name for csrc in CSRC])
def test_math_stands_below_everything(csrc):
    headers = {path.name for path in (csrc / "math").iterdir()}
    for path, name in includes(csrc / "math"):
        assert (
            name in headers or name == "../data.h" or re.fullmatch(r"gs/\w+\.h|c\w+|limits|algorithm|type_traits", name)
        ), path


@pytest.mark.skipif(shutil.which("nm") is None, reason="needs nm of the binary utilities")
@pytest.mark.parametrize("package", PACKAGES)
def test_a_library_uses_torch_through_its_stable_interface_alone(package):
    library = Path(importlib.util.find_spec(package).origin).with_name("_backend.so")
    symbols = subprocess.run(["nm", "-D", str(library)], capture_output=True, text=True, check=True).stdout
    names = [line.split()[-1].partition("@")[0] for line in symbols.splitlines()]
    assert "torch_library_impl" in names
    forbidden = re.compile(r"_Z.*N[VK]*(3c10|2at|5torch|8pybind11)\d|_?Py[A-Z_]")
    assert [name for name in names if forbidden.match(name)] == []
