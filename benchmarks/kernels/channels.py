"""Time and memory of images of several channels: forward and backward, all Gaussians' gradients included.

    python -m benchmarks.kernels.channels [--device cpu] [--workloads S M L] [--channels 3 4 16 32 64]

`rasterize` is the usual function of three channels. Random splats in a frustum, in Morton order.
"""

import argparse

import torch
from diff_gaussian_rasterization import rasterize
from diff_gaussian_rasterization.channels import rasterize_channels
from torch import Tensor

from benchmarks.harness.measuring import (
    add_device,
    choose_device,
    cpu_milliseconds,
    describe_machine,
    gpu_milliseconds,
    measure_peak_mib,
    print_table,
)
from tests.workloads.splat_scenes import CPU_WORKLOADS, GPU_WORKLOADS, SplatScene, frustum, sort_by_morton
from utils.system_utils import run_cli

_REPEATS = 5  # on a CPU


class Call:
    """Forward and backward of an image with so many channels; of `rasterize` if None."""

    def __init__(self, scene: SplatScene, channels: int | None) -> None:
        """Draw random colours or features, and a random gradient of the image.

        channels: number of channels; None: three, by `rasterize`.
        """
        self._inputs = {k: v for k, v in scene.leaves(torch.float32).items() if not k.startswith("sh")}
        count, width = len(self._inputs["means"]), channels or 3
        generator = torch.Generator(device=self._inputs["means"].device).manual_seed(0)
        like = {"device": self._inputs["means"].device, "generator": generator}
        name = "colors" if channels is None else "features"
        self._inputs[name] = torch.rand(count, width, **like).requires_grad_()
        self._settings = scene.settings(torch.float32)._replace(bg=torch.zeros(width, device=like["device"]))
        self._means2d = torch.zeros_like(self._inputs["means"]).requires_grad_()
        self._draw = rasterize if channels is None else rasterize_channels
        self._gradient = torch.randn(width, scene.height, scene.width, **like)

    def image(self) -> Tensor:
        return self._draw(means2d=self._means2d, settings=self._settings, raw=True, **self._inputs)[0]

    def __call__(self) -> None:
        self.clear()
        self.image().backward(self._gradient)

    def clear(self) -> None:
        for values in (*self._inputs.values(), self._means2d):
            values.grad = None


def main() -> None:
    """Print time and memory of images with each number of channels, beside those of `rasterize`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_device(parser)
    parser.add_argument(
        "--workloads", nargs="+", choices=GPU_WORKLOADS, default=["S", "M", "L"], help="on a GPU (default: S M L)"
    )
    parser.add_argument("--channels", nargs="+", type=int, default=[3, 4, 16, 32, 64], help="(default: 3 4 16 32 64)")
    args = parser.parse_args()
    device = choose_device(args)
    print(describe_machine(device), end="\n\n")
    on_gpu = device != "cpu"
    workloads = {name: GPU_WORKLOADS[name] for name in args.workloads} if on_gpu else {"M": CPU_WORKLOADS["M"]}
    rows = []
    for workload, form in workloads.items():
        scene = sort_by_morton(frustum(*form, device=device))
        base = None
        for channels in (None, *args.channels):
            call = Call(scene, channels)
            with torch.no_grad():
                forward = gpu_milliseconds(call.image) if on_gpu else cpu_milliseconds(call.image, _REPEATS)
            both = gpu_milliseconds(call) if on_gpu else cpu_milliseconds(call, _REPEATS)
            base = base or both
            memory = f"{measure_peak_mib(call, call.clear):.0f}" if on_gpu else ""
            name = "rasterize" if channels is None else str(channels)
            rows.append([workload, name, f"{forward:.3f}", f"{both:.3f}", f"{both / base:.2f}", memory])
    print_table(["workload", "channels", "forward", "+ backward", "times rasterize", "MiB"], rows)


if __name__ == "__main__":
    run_cli(main)
