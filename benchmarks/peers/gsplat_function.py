"""gsplat's `rasterization` by its own kernels, and ours of the same name: difference, milliseconds and memory.

    python -m benchmarks.peers.gsplat_function [--workloads S M L] [--channels 3 16 32 64]

Needs a GPU and gsplat, whose kernels are compiled at the first call. Random splats in a frustum, in Morton order, one
camera. A difference is of a pixel, or of a Gaussian's gradient, over the largest value of gsplat's: that of 99.9 % of
all, and the largest. Where rounding decides whether a pixel shows a splat, an alpha of 1/255 is there or not.
"""

import argparse
from collections.abc import Callable

import torch
from diff_gaussian_rasterization.gsplat import rasterization as ours
from torch import Tensor

from benchmarks.harness.measuring import describe_machine, gpu_milliseconds, measure_peak_mib, print_table
from tests.workloads.splat_scenes import GPU_WORKLOADS, SplatScene, frustum, sort_by_morton
from utils.system_utils import UserError, run_cli

_MOST = 0.999
_NAMES = ("means", "quats", "scales", "opacities", "colors")


class Call:
    """Forward and backward of an image with so many channels by one of both functions."""

    def __init__(self, function: Callable, scene: SplatScene, channels: int, packed: bool) -> None:
        """Draw random colours and a random gradient of the image.

        function: `rasterization`, gsplat's or ours.
        channels: number of channels.
        packed: argument of the function.
        """
        given, device = scene.parameters, scene.parameters["means"].device
        generator = torch.Generator(device).manual_seed(0)
        rows = [given["means"], given["rotations"], given["scales"].exp(), given["opacities"].sigmoid().flatten()]
        rows.append(torch.rand(len(rows[0]), channels, device=device, generator=generator))
        self.inputs = [values.detach().clone().requires_grad_() for values in rows]
        view, K, width, height = scene.pinhole()
        background = torch.zeros(1, channels, device=device)
        self._options = {"width": width, "height": height, "packed": packed, "backgrounds": background}
        self._camera = view[None], K[None]
        self._gradient = torch.randn(1, height, width, channels, device=device, generator=generator)
        self._draw = function

    def image(self) -> Tensor:
        return self._draw(*self.inputs, *self._camera, **self._options)[0]

    def __call__(self) -> None:
        self.clear()
        self.image().backward(self._gradient)

    def clear(self) -> None:
        for values in self.inputs:
            values.grad = None

    def results(self) -> dict[str, Tensor]:
        """The image (pixels, channels) and the gradients (rows, values)."""
        self()
        with torch.no_grad():
            image = self.image()[0].flatten(0, 1)
        return {"image": image} | {n: v.grad.reshape(len(v), -1) for n, v in zip(_NAMES, self.inputs, strict=True)}


def difference(found: Tensor, wanted: Tensor) -> tuple[float, float]:
    """The difference of 99.9 % of the rows, and the largest one, over the largest value."""
    apart = ((found - wanted).abs() / wanted.abs().max()).amax(1)
    return torch.quantile(apart, _MOST).item(), apart.max().item()


def main() -> None:
    """Print times, memory and differences of both functions on the workloads."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--workloads", nargs="+", choices=GPU_WORKLOADS, default=["S", "M", "L"], help="(default: S M L)"
    )
    parser.add_argument("--channels", nargs="+", type=int, default=[3, 16, 32, 64], help="(default: 3 16 32 64)")
    args = parser.parse_args()
    if not torch.cuda.is_available():
        raise UserError("this needs a GPU")
    try:
        import gsplat
    except ImportError:
        raise UserError("install gsplat 1.6, whose kernels are measured") from None
    print(f"{describe_machine('cuda')}, gsplat {gsplat.__version__}", end="\n\n")
    times, differences = [], []
    for workload in args.workloads:
        scene = sort_by_morton(frustum(*GPU_WORKLOADS[workload], device="cuda"))
        for channels in args.channels:
            calls = [Call(function, scene, channels, packed=False) for function in (gsplat.rasterization, ours)]
            row = [workload, str(channels)]
            milliseconds = [(_time_forward(call), gpu_milliseconds(call)) for call in calls]
            row += [f"{time:.2f}" for one in milliseconds for time in one]
            row.append(f"{milliseconds[0][1] / milliseconds[1][1]:.2f}")
            times.append(row + [f"{measure_peak_mib(call, call.clear):.0f}" for call in calls])
            wanted, found = (call.results() for call in calls)
            apart = [difference(found[name], values) for name, values in wanted.items()]
            cells = [f"{most:.0e}, {largest:.0e}" for most, largest in apart]
            differences.append([workload, str(channels), *cells])
            del calls, wanted, found
    print_table(
        ["workload", "channels", "gsplat forward", "+ backward", "ours", "+ backward", "times", "MiB", "MiB, ours"],
        times,
    )
    print()
    print_table(["workload", "channels", "image", *_NAMES], differences)


def _time_forward(call: Call) -> float:
    with torch.no_grad():
        return gpu_milliseconds(call.image)


if __name__ == "__main__":
    run_cli(main)
