"""Lists that several blocks of a GPU share. These wait for each other, so each test has a process and a deadline."""

import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from diff_gaussian_rasterization.scene import GRADIENTS, Drawing, draw
from rasterizer_tools import GPU_MARKS, error, scene_arguments
from torch import Tensor

from tests.workloads.splat_scenes import FOV, PARAMETERS, SplatScene, move_camera, settings

pytestmark = [*GPU_MARKS]
OPS = torch.ops.diff_gaussian_rasterization
ROOT = Path(__file__).parents[1]
DEADLINE = 180  # seconds; the slowest takes some ten, most of them to start
CALL = """
import sys
sys.path[:0] = ["tests", "."]
import groundwork.host.openmp
import test_long_lists_cuda
"""
WANTED = [name in (*PARAMETERS, "means2d") for name in GRADIENTS]


def heap(
    n: int = 200_000, width: int = 400, height: int = 400, seed: int = 0, device: torch.device | str = "cpu"
) -> SplatScene:
    """Draw small Gaussians in a cube that covers the middle of the image, densest at its centre, as of an object.

    Some tiles have lists of thousands, most have few or none. With the default numbers, the longest has some 7,100, of
    which half are processed; of all instances 92 % are. The median size is 1.2 px.
    """
    g = torch.Generator().manual_seed(seed)  # the same on every device
    uniform = 2 * torch.rand(n, 3, generator=g) - 1
    means = 1.2 * uniform.sign() * uniform.abs() ** 1.3 + torch.tensor([0.0, 0.0, 4.2])
    focal = width / (2 * math.tan(FOV / 2))
    size = torch.log(1.2 * means[:, 2] / focal) + 0.6 * torch.randn(n, generator=g)
    parameters = {
        "means": means,
        "opacities": 1.2 * torch.randn(n, 1, generator=g) - 3,
        "scales": size[:, None] + (torch.rand(n, 3, generator=g) - 0.5) * math.log(5.0),
        "rotations": torch.randn(n, 4, generator=g),
        "sh_dc": 0.8 * torch.randn(n, 1, 3, generator=g),
        "sh_rest": 0.1 * torch.randn(n, 15, 3, generator=g),
    }
    return SplatScene(parameters, width, height).to(device)


class View:
    """A heap of splats, some of whose tiles have lists of thousands, and a gradient of its image."""

    def __init__(self, count: int, width: int, height: int, device: str = "cuda") -> None:
        scene, camera = heap(count, width, height, device=device), settings(width, height, torch.float32)
        self.size, self.camera = (height, width), move_camera(camera, device)
        self.scene = scene_arguments(scene.parameters, self.camera)
        planes = torch.randn(4, height, width, generator=torch.Generator().manual_seed(3)).to(device)
        self.color, self.depth = planes[:3], planes[3:]
        out = self.forward(True)
        self.room = [len(out[6]), len(out[9]), len(out[6]), 0]  # of instances, slots and gradient rows, at most

    def forward(self, inverse_depth: bool) -> Drawing:
        return draw(self.scene, self.camera.bg, inverse_depth)

    def backward(self, out: Drawing, inverse_depth: bool, layers: Tensor) -> tuple[Tensor, ...]:
        kept = out._replace(layers=layers).kept(self.camera.bg)
        return OPS.rasterize_vjp(*self.scene, WANTED, kept, self.color, None, self.depth if inverse_depth else None)

    def both(self) -> list[Tensor]:
        out = self.forward(True)
        return [*out[:3], out[10], *self.backward(out, True, out[11])]

    def ahead(self, words: Tensor, room: list[int]) -> list[Tensor]:
        """Does the same without waiting for the GPU: `run_ahead_` has the arguments."""
        OPS.run_ahead_(words, room, None)
        try:
            return self.both()
        finally:
            OPS.run_ahead_(None, [], None)


def same_bits(one: list[Tensor], other: list[Tensor]) -> bool:
    return all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def lists_of_thousands(inverse_depth: bool) -> None:
    """Each pixel ends where the CPU ends it, and the layers of the forward serve as well as those of the backward."""
    view = View(30_000, 90, 75)
    projected = OPS.project(*view.scene)
    instances, ranges, *_ = OPS.bin(*projected[:4], *view.size, False)
    assert ranges.diff().max() > 4000 and ranges.diff().min() < 256
    lists = projected[0], instances, ranges, view.camera.bg
    planes = OPS.blend(*lists, *view.size, inverse_depth, True)
    cpu = OPS.blend(*(t.cpu() for t in lists), *view.size, inverse_depth, True)
    ends = planes[3].cpu() == cpu[3]
    assert ends.float().mean() > 0.98  # rounding decides the others
    for got, wanted in zip(planes[:3], cpu[:3], strict=True):
        off = ((got.cpu() - wanted).abs() > 1e-5).any(0)  # the CPU's error is 3e-6
        assert (off & ends).float().mean() <= 0.002  # pixels at a cut-off
    for train in (True, False):
        assert same_bits(OPS.blend(*lists, *view.size, inverse_depth, train)[:3], planes[:3])
    out = view.forward(inverse_depth)
    assert out[11].numel() > 0
    made, own, again = (view.backward(out, inverse_depth, x) for x in (out[11], out[11].new_empty(0), out[11]))
    assert same_bits(made, again)
    # Either is within 9e-6 of double on ordinary scenes; see docs/results/accuracy.md.
    assert all(error(a, b).largest < 2e-5 for a, b in zip(made, own, strict=True) if a.numel())


def beside_other_work() -> None:
    """On several streams at once, few blocks of a launch run at a time, and they start at any time."""
    view = View(60_000, 300, 200)
    wanted, product = view.both(), torch.randn(2048, 2048, device="cuda")
    streams = [torch.cuda.Stream() for _ in range(4)]
    words = [torch.zeros(6, dtype=torch.int64, device="cuda") for _ in streams]
    torch.cuda.synchronize()
    results = []
    for _ in range(25):
        for stream, own in zip(streams, words, strict=True):
            with torch.cuda.stream(stream):
                product @ product
                results.append(view.ahead(own, view.room))
    torch.cuda.synchronize()
    assert not torch.stack(words)[:, 0].any()
    assert all(same_bits(result, wanted) for result in results)


def any_room() -> None:
    """More room changes no bit. With less, the step halts, and the next one that has enough is as if nothing was."""
    view = View(30_000, 90, 75)
    wanted, words = view.both(), torch.zeros(6, dtype=torch.int64, device="cuda")
    for step, more in enumerate((0, 1, 255, 256, 100_000, 3_000_000), 1):
        got = view.ahead(words, [room + more for room in view.room])
        assert words[0] == 0 and same_bits(got, wanted), more
        for place in range(2):
            less = list(view.room)
            less[place] -= 1
            view.ahead(words, less)
            view.ahead(words, view.room)
            assert words[0] == step + 1 and words[5] == step
            words[0] = 0


CASES = {
    "lists of thousands": "lists_of_thousands(False)",
    "lists of thousands with depth": "lists_of_thousands(True)",
    "beside other work": "beside_other_work()",
    "any room": "any_room()",
}


@pytest.mark.parametrize("call", CASES.values(), ids=CASES.keys())
def test_blocks_share_a_list(call):
    command = [sys.executable, "-c", f"{CALL}\ntest_long_lists_cuda.{call}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=DEADLINE)
    assert done.returncode == 0, done.stderr
