"""distCUDA2 against SciPy's kd-tree and all pairs in float64."""

import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import simple_knn
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from simple_knn._C import distCUDA2
from simple_knn.reference import mean_distance2
from torch import library

# Some eight rounded operations on each side; differences of coordinates are taken before squaring.
RTOL = {torch.float32: 8 * 2**-24, torch.float64: 8 * 2**-53}
both_dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def by_scipy(points: torch.Tensor) -> torch.Tensor:
    distances, _ = cKDTree(points.double().numpy()).query(points.double().numpy(), k=4)
    return torch.from_numpy((distances[:, 1:] ** 2).mean(1))


def cloud(name: str) -> torch.Tensor:
    """Named clouds in float32 (N, 3), each difficult for some way of searching."""
    random = torch.Generator().manual_seed(3)
    x = torch.randn(3000, 3, generator=random)
    if name == "collinear":
        return x[:, :1] * torch.tensor([1.0, 2.0, -0.5])
    if name == "planar":
        return x * torch.tensor([1.0, 0.0, 1.0])
    if name == "duplicates":
        return x[torch.randint(700, (3000,), generator=random)]
    if name == "all equal":
        return torch.full((3000, 3), 0.3)
    if name == "outliers":
        return torch.cat([x * 1e-3, x[:5] * 1e6, torch.full((1, 3), 1e15)])
    if name == "large offset":
        return x + torch.tensor([5e5, 4e6, 100.0])
    if name == "tiny":
        return x * 1e-15
    return x


CLOUDS = ["normal", "collinear", "planar", "duplicates", "all equal", "outliers", "large offset", "tiny"]


@both_dtypes
@pytest.mark.parametrize("name", CLOUDS)
def test_agrees_with_scipy(name: str, dtype: torch.dtype) -> None:
    points = cloud(name).to(dtype)
    got = distCUDA2(points)
    assert got.dtype == dtype
    # SciPy gives distances; their squares are rounded once more.
    torch.testing.assert_close(got.double(), by_scipy(points), rtol=RTOL[dtype] + 4 * 2**-53, atol=0)


@both_dtypes
@pytest.mark.parametrize("count", [0, 1, 2, 3, 4, 5, 9, 40])
def test_small_clouds_agree_with_all_pairs(count: int, dtype: torch.dtype) -> None:
    points = cloud("normal")[:count].to(dtype)
    got = distCUDA2(points)
    assert got.shape == (count,)
    torch.testing.assert_close(got.double(), mean_distance2(points), rtol=RTOL[dtype], atol=0)


def test_tiny_clouds_by_hand() -> None:
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 3, 0], [0, 0, 0]])
    assert distCUDA2(points[:1]).tolist() == [0]
    assert distCUDA2(points[:2]).tolist() == [1, 1]
    assert distCUDA2(points[:3]).tolist() == [5, 5.5, 9.5]
    torch.testing.assert_close(distCUDA2(points), torch.tensor([10 / 3, 4, 28 / 3, 10 / 3]))


@given(
    st.lists(
        st.tuples(*[st.sampled_from([0.0, 1.0, -2.0, 0.5, 1e-3, 7e4, float("nan"), float("inf")])] * 3), max_size=40
    )
)
@settings(deadline=None, max_examples=100)
def test_any_cloud_agrees_with_all_pairs(rows: list[tuple[float, float, float]]) -> None:
    points = torch.tensor(rows, dtype=torch.float32).reshape(-1, 3)
    torch.testing.assert_close(distCUDA2(points).double(), mean_distance2(points), rtol=RTOL[torch.float32], atol=0)


def test_not_finite_points_are_apart() -> None:
    points = cloud("normal")[:50].clone()
    points[7, 1] = float("nan")
    points[20, 0] = float("inf")
    good = points.isfinite().all(1)
    got = distCUDA2(points)
    assert got[~good].tolist() == [0, 0]
    assert torch.equal(got[good], distCUDA2(points[good]))


def test_overflow_stays_finite() -> None:
    points = torch.tensor([[1e30, 0, 0], [-1e30, 0, 0], [0, 2e38, 0], [0, -2e38, 0]])
    assert (distCUDA2(points) == torch.finfo(torch.float32).max).all()


def test_order_of_points_does_not_matter() -> None:
    points = cloud("duplicates")
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))
    assert torch.equal(distCUDA2(points[order]), distCUDA2(points)[order])


def test_same_bits_for_any_number_of_threads() -> None:
    points = torch.cat([cloud("normal"), cloud("duplicates"), cloud("outliers")])
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 2, 3, 7):
            torch.set_num_threads(threads)
            results.append(distCUDA2(points))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(result, results[0]) for result in results)


def test_not_contiguous() -> None:
    points = cloud("normal")
    wanted = distCUDA2(points)
    assert torch.equal(distCUDA2(points.T.contiguous().T), wanted)
    assert torch.equal(distCUDA2(torch.cat([points, points], 1)[:, :3]), wanted)


def test_large_cloud_is_not_quadratic() -> None:
    # All pairs of 200 k points are 4e10 distances, which take more than a minute; the tree takes 0.3 s on two cores.
    # The process's own time is measured, to which other programs do not add. The second cloud puts nearly all points
    # into one cell of any uniform grid.
    near = torch.rand(200_000, 3, generator=torch.Generator().manual_seed(1))
    for points in (near, torch.cat([near, near[:10] * 1e6])):
        start = time.process_time()
        distCUDA2(points)
        assert time.process_time() - start < 10


def test_opcheck() -> None:
    for points in (cloud("normal")[:20], cloud("normal")[:0].double()):
        library.opcheck(torch.ops.simple_knn.mean_distance2, (points,))


def test_has_no_gradient() -> None:
    assert not distCUDA2(torch.zeros(4, 3, requires_grad=True)).requires_grad


def test_messages() -> None:
    with pytest.raises(ValueError, match=r"points must be \(N, 3\), got \(5, 2\)"):
        distCUDA2(torch.zeros(5, 2))
    with pytest.raises(ValueError, match=r"points must be \(N, 3\), got \(3,\)"):
        distCUDA2(torch.zeros(3))
    with pytest.raises(TypeError, match=r"float32 or float64, got torch.int64"):
        distCUDA2(torch.zeros(5, 3, dtype=torch.int64))
    # The operator itself checks inputs that bypass the Python function.
    with pytest.raises(RuntimeError, match=r"points must be \(N, 3\)"):
        torch.ops.simple_knn.mean_distance2(torch.zeros(5, 2))
    with pytest.raises(RuntimeError, match="points must be float32 or float64"):
        torch.ops.simple_knn.mean_distance2(torch.zeros(5, 3, dtype=torch.float16))


def test_numpy_double_reference_is_itself_right() -> None:
    points = cloud("normal")[:100]
    np.testing.assert_allclose(mean_distance2(points), by_scipy(points), rtol=1e-14)


@pytest.mark.parametrize(("library", "what"), [(None, "is not built"), (b"not a library", "does not fit torch 2")])
def test_unusable_library_ends_in_the_remedy(library: bytes | None, what: str, tmp_path: Path) -> None:
    package = tmp_path / "simple_knn"
    package.mkdir()
    for name in ("__init__.py", "backend.py", "operators.py", "ops.py", "_C.py"):
        shutil.copy(Path(simple_knn.__file__).with_name(name), package)
    if library:
        (package / "_backend.so").write_bytes(library)
    done = subprocess.run([sys.executable, "-c", "import simple_knn._C"], cwd=tmp_path, capture_output=True, text=True)
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"ImportError: simple_knn {what}")
    assert last.endswith("run `pip install ./submodules/simple-knn` in the repository")
