"""distCUDA2 against SciPy's kd-tree, all pairs in float64, and on a GPU against the CPU."""

import platform
import shutil
import time
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest
import simple_knn
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterizer_tools import CPU_AND_GPU, GPU_MARKS
from scipy.spatial import cKDTree
from simple_knn._C import distCUDA2
from simple_knn.reference import mean_distance2

# Some eight rounded operations on each side; differences of coordinates are taken before squaring.
RTOL = {torch.float32: 8 * 2**-24, torch.float64: 8 * 2**-53}
on_a_gpu = pytest.mark.parametrize("device", [pytest.param("cuda", marks=GPU_MARKS)])
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


def distances(points: torch.Tensor, device: str) -> torch.Tensor:
    """The distances by the device, on the CPU; those of a GPU are compared with the CPU's."""
    got = distCUDA2(points.to(device))
    assert got.device.type == device and got.dtype == points.dtype and got.shape == points.shape[:1]
    if device == "cuda":
        wanted = distCUDA2(points)
        if platform.machine() == "x86_64":  # elsewhere the compiler may fuse products with sums
            assert torch.equal(got.cpu(), wanted)
        torch.testing.assert_close(got.cpu(), wanted, rtol=RTOL[points.dtype], atol=0)
    return got.cpu()


@CPU_AND_GPU
@both_dtypes
@pytest.mark.parametrize("name", CLOUDS)
def test_agrees_with_scipy(name: str, dtype: torch.dtype, device: str) -> None:
    points = cloud(name).to(dtype)
    got = distances(points, device)
    # SciPy gives distances; their squares are rounded once more.
    torch.testing.assert_close(got.double(), by_scipy(points), rtol=RTOL[dtype] + 4 * 2**-53, atol=0)


@given(
    st.lists(
        st.tuples(*[st.sampled_from([0.0, 1.0, -2.0, 0.5, 1e-3, 7e4, float("nan"), float("inf")])] * 3), max_size=40
    )
)
@settings(deadline=None, max_examples=100)
def test_any_cloud_agrees_with_all_pairs(rows: list[tuple[float, float, float]]) -> None:
    points = torch.tensor(rows, dtype=torch.float32).reshape(-1, 3)
    torch.testing.assert_close(distCUDA2(points).double(), mean_distance2(points), rtol=RTOL[torch.float32], atol=0)


@CPU_AND_GPU
@both_dtypes
def test_not_finite_points_are_apart(dtype: torch.dtype, device: str) -> None:
    points = cloud("normal")[:500].to(dtype)
    points[7, 1] = float("nan")
    points[[0, 20, 499], 0] = float("inf")
    good = points.isfinite().all(1)
    got = distances(points, device)
    assert got[~good].tolist() == [0] * 4
    assert torch.equal(got[good], distances(points[good], device))
    assert not distances(torch.full((70, 3), float("nan"), dtype=dtype), device).any()


@CPU_AND_GPU
def test_overflow_stays_finite(device: str) -> None:
    largest = torch.finfo(torch.float32).max
    points = torch.tensor([[1e30, 0, 0], [-1e30, 0, 0], [0, 2e38, 0], [0, -2e38, 0]])
    assert (distances(points, device) == largest).all()
    assert distances(largest * torch.tanh(cloud("normal")), device).isfinite().all()
    distances(cloud("normal").double() * 1e300, device)  # beyond the range of float, in which the tree is planned


@CPU_AND_GPU
def test_order_and_strides_of_points_do_not_matter(device: str) -> None:
    points = torch.cat([cloud("normal"), cloud("duplicates"), cloud("outliers")]).to(device)
    wanted = distCUDA2(points)
    for seed in range(10 if device == "cuda" else 1):
        order = torch.randperm(len(points), generator=torch.Generator().manual_seed(seed)).to(device)
        assert torch.equal(distCUDA2(points), wanted)
        assert torch.equal(distCUDA2(points[order]), wanted[order])
    assert torch.equal(distCUDA2(points.T.contiguous().T), wanted)  # of any strides


def test_large_cloud_is_not_quadratic() -> None:
    # All pairs of 200 k points are 4e10 distances, which take more than a minute; the tree takes 0.3 s on two cores.
    # The process's own time is measured, to which other programs do not add. The second cloud puts nearly all points
    # into one cell of any uniform grid.
    near = torch.rand(200_000, 3, generator=torch.Generator().manual_seed(1))
    for points in (near, torch.cat([near, near[:10] * 1e6])):
        start = time.process_time()
        distCUDA2(points)
        assert time.process_time() - start < 10


@on_a_gpu
def test_millions_take_no_time(device: str) -> None:
    points = torch.randn(4_000_000, 3, device=device, generator=torch.Generator(device).manual_seed(1))
    for many in (points, torch.cat([points, points[:100] * 1e6])):
        distCUDA2(many[:1000])
        torch.cuda.synchronize()
        start = time.perf_counter()
        got = distCUDA2(many)
        torch.cuda.synchronize()
        assert time.perf_counter() - start < 2  # all pairs would take minutes
        some = torch.arange(0, len(many), 400_003, device=device)
        nearest = torch.stack([(many - many[i]).double().square().sum(1).topk(4, largest=False)[0] for i in some])
        torch.testing.assert_close(got[some].double(), nearest[:, 1:].mean(1), rtol=RTOL[torch.float32], atol=0)


@on_a_gpu
def test_runs_on_the_current_stream(device: str) -> None:
    points = cloud("normal").to(device)
    wanted = distCUDA2(points)
    late = torch.zeros_like(points)
    torch.cuda.synchronize()
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        torch.cuda._sleep(50_000_000)  # tens of milliseconds in which another stream would read the zeros
        late.copy_(points)
        got = distCUDA2(late)
    stream.synchronize()
    assert torch.equal(got, wanted)


@pytest.mark.parametrize(("library", "what"), [(None, "is not built"), (b"not a library", "does not fit torch 2")])
def test_unusable_library_ends_in_the_remedy(library: bytes | None, what: str, tmp_path: Path) -> None:
    shutil.copy(Path(simple_knn.__file__).with_name("backend.py"), tmp_path)
    if library:
        (tmp_path / "_backend.so").write_bytes(library)
    found = spec_from_file_location("simple_knn.backend", tmp_path / "backend.py")
    with pytest.raises(ImportError) as error:
        found.loader.exec_module(module_from_spec(found))
    said = str(error.value)
    assert said.startswith(f"simple_knn {what}")
    assert said.endswith("run `pip install ./submodules/simple-knn` in the repository")
