"""distCUDA2 on the GPU against the CPU backend, SciPy's kd-tree, all pairs in float64 and itself."""

import platform
import time

import pytest
import torch
from simple_knn._C import distCUDA2
from simple_knn.reference import mean_distance2
from test_simple_knn import CLOUDS, RTOL, both_dtypes, by_scipy, cloud
from torch import library

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no NVIDIA GPU"),
]


def check(points: torch.Tensor) -> torch.Tensor:
    """Compute the distances of `points` on the GPU, compare them with the CPU's, and return them on the CPU."""
    got = distCUDA2(points.cuda())
    assert got.is_cuda and got.dtype == points.dtype and got.shape == points.shape[:1]
    wanted = distCUDA2(points)
    if platform.machine() == "x86_64":  # elsewhere the compiler may fuse products with sums
        assert torch.equal(got.cpu(), wanted)
    torch.testing.assert_close(got.cpu(), wanted, rtol=RTOL[points.dtype], atol=0)
    return got.cpu()


@both_dtypes
@pytest.mark.parametrize("name", CLOUDS)
def test_agrees_with_the_cpu_and_scipy(name: str, dtype: torch.dtype) -> None:
    points = cloud(name).to(dtype)
    torch.testing.assert_close(check(points).double(), by_scipy(points), rtol=RTOL[dtype] + 4 * 2**-53, atol=0)


@both_dtypes
@pytest.mark.parametrize("count", [0, 1, 2, 3, 4, 5, 8, 9, 16, 17, 33, 257])
def test_small_clouds_agree_with_all_pairs(count: int, dtype: torch.dtype) -> None:
    points = cloud("normal")[:count].to(dtype)
    torch.testing.assert_close(check(points).double(), mean_distance2(points), rtol=RTOL[dtype], atol=0)


def test_tiny_clouds_by_hand() -> None:
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 3, 0]], device="cuda")
    assert distCUDA2(points[:1]).tolist() == [0]
    assert distCUDA2(points[:2]).tolist() == [1, 1]
    assert distCUDA2(points).tolist() == [5, 5.5, 9.5]


@both_dtypes
def test_not_finite_points_are_apart(dtype: torch.dtype) -> None:
    points = cloud("normal")[:500].to(dtype)
    points[7, 1] = float("nan")
    points[[0, 20, 499], 0] = float("inf")
    assert check(points)[[0, 7, 20, 499]].tolist() == [0] * 4
    check(torch.full((70, 3), float("nan"), dtype=dtype))


def test_overflow_stays_finite() -> None:
    points = torch.tensor([[1e30, 0, 0], [-1e30, 0, 0], [0, 2e38, 0], [0, -2e38, 0]])
    assert (check(points) == torch.finfo(torch.float32).max).all()
    check(torch.finfo(torch.float32).max * torch.tanh(cloud("normal")))
    check(cloud("normal").double() * 1e300)  # beyond the range of float, in which the tree is planned


def test_large_clouds() -> None:
    near = torch.rand(200_000, 3, generator=torch.Generator().manual_seed(1))
    plane = near * torch.tensor([1, 1, 1e-6])
    for points in (near, torch.cat([near, near[:10] * 1e6]), plane, near.round(decimals=2)):
        check(points)


def test_millions_take_no_time() -> None:
    points = torch.randn(4_000_000, 3, device="cuda", generator=torch.Generator("cuda").manual_seed(1))
    for many in (points, torch.cat([points, points[:100] * 1e6])):
        distCUDA2(many[:1000])
        torch.cuda.synchronize()
        start = time.perf_counter()
        distances = distCUDA2(many)
        torch.cuda.synchronize()
        assert time.perf_counter() - start < 2  # all pairs would take minutes
        some = torch.arange(0, len(many), 400_003, device="cuda")
        nearest = torch.stack([(many - many[i]).double().square().sum(1).topk(4, largest=False)[0] for i in some])
        torch.testing.assert_close(distances[some].double(), nearest[:, 1:].mean(1), rtol=RTOL[torch.float32], atol=0)


def test_every_run_and_every_order_give_the_same_bits() -> None:
    points = torch.cat([cloud("normal"), cloud("duplicates"), cloud("outliers")]).cuda()
    wanted = distCUDA2(points)
    for seed in range(10):
        order = torch.randperm(len(points), generator=torch.Generator().manual_seed(seed)).cuda()
        assert torch.equal(distCUDA2(points), wanted)
        assert torch.equal(distCUDA2(points[order]), wanted[order])


def test_not_contiguous() -> None:
    points = cloud("normal").cuda()
    wanted = distCUDA2(points)
    assert torch.equal(distCUDA2(points.T.contiguous().T), wanted)
    assert torch.equal(distCUDA2(torch.cat([points, points], 1)[:, :3]), wanted)


def test_runs_on_the_current_stream() -> None:
    points = cloud("normal").cuda()
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


def test_opcheck() -> None:
    for points in (cloud("normal")[:20].cuda(), cloud("normal")[:0].double().cuda()):
        library.opcheck(torch.ops.simple_knn.mean_distance2, (points,))


def test_messages() -> None:
    with pytest.raises(TypeError, match="float32 or float64, got torch.float16"):
        distCUDA2(torch.zeros(5, 3, device="cuda", dtype=torch.float16))
    with pytest.raises(RuntimeError, match=r"points must be \(N, 3\)"):
        torch.ops.simple_knn.mean_distance2(torch.zeros(5, 2, device="cuda"))
