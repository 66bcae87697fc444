"""Images without gradients, of SH of degree 3: gsplat's function and ours, our rasterizer, gsplat's HiGS, Faster-GS.

    python -m benchmarks.peers.images [--workloads S M M+ 4K L XL]
    python -m benchmarks.peers.images --models OUT ... --sizes 1920x1080 3840x2160

Needs a GPU and gsplat 1.6 with its experimental kernels, and for Faster-GS its FasterGSCudaBackend; what is missing or
fails is left out, and named. Milliseconds by events, of the kernels alone, and of the host until the call returns;
frames a second of calls in a row; and how far an image is from ours, as PSNR (dB). Random splats in a frustum, in
Morton order, or models of train.py from the training view that sees the median number of Gaussians.
"""

import argparse
import math
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import torch
from diff_gaussian_rasterization import rasterize
from diff_gaussian_rasterization.gsplat import rasterization as ours
from torch import Tensor

from benchmarks.harness.measuring import REPEATS, describe_machine, gpu_time, print_table
from benchmarks.kernels.rasterizer import load_trained
from tests.workloads.splat_scenes import GPU_WORKLOADS, SplatScene, frustum, settings, sort_by_morton
from utils.system_utils import UserError, run_cli

Image = Callable[[], Tensor]  # (H, W, 3)
_IN_A_ROW = 300  # frames


def make_draws(scene: SplatScene) -> dict[str, Callable[[], Image]]:
    """Make for each way to draw a scene, by name, a function that prepares a drawing function."""
    import gsplat

    given, (view, K, width, height) = scene.parameters, scene.pinhole()
    sh = torch.cat([given["sh_dc"], given["sh_rest"]], 1).contiguous()
    quats = torch.nn.functional.normalize(given["rotations"])
    shape = quats, given["scales"].exp(), given["opacities"].sigmoid().flatten()

    def by_function(function: Callable, packed: bool) -> Callable[[], Image]:
        inputs = given["means"], *shape, sh, view[None], K[None], width, height
        return lambda: lambda: function(*inputs, sh_degree=3, packed=packed)[0][0]

    def by_rasterize() -> Image:
        zeros = torch.zeros_like(given["means"])
        settings = scene.settings(torch.float32, bg=torch.zeros(3))
        return lambda: rasterize(means2d=zeros, settings=settings, raw=True, **given).color.permute(1, 2, 0)

    def by_higs(tile: int, compression: str) -> Callable[[], Image]:
        """Return a function that prepares gsplat's HiGS and returns a function that draws by it."""

        def made() -> Image:
            from gsplat.experimental import GaussianInferenceRenderer, GaussianInferenceScene

            packed = GaussianInferenceScene.from_gaussian_tensors(
                given["means"], *shape, sh, sh_degree=3, sh_compression=compression, id=f"{tile} {compression}"
            )
            renderer = GaussianInferenceRenderer(packed, tile_size=tile)
            return lambda: renderer.render(viewmat=view, K=K, width=width, height=height).frame[0, ..., :3]

        return made

    def by_faster_gs() -> Image:
        from FasterGSCudaBackend.torch_bindings import RasterizerSettings
        from FasterGSCudaBackend.torch_bindings import rasterize as draw

        place, black = view.inverse()[:3, 3].contiguous(), torch.zeros(3, device=view.device)
        numbers = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
        camera = RasterizerSettings(view, place, black, 16, width, height, *numbers, 0.2, 1e4, False)
        rows = [given[name].contiguous() for name in ("means", "scales", "rotations", "opacities", "sh_dc", "sh_rest")]
        return lambda: draw(*rows, camera, to_chw=False, clamp_output=False)

    found = {"rasterize": by_rasterize, "Faster-GS": by_faster_gs}
    for name, function in (("ours", ours), ("gsplat", gsplat.rasterization)):
        found |= {
            f"{name}, {'packed' if packed else 'dense'}": by_function(function, packed) for packed in (False, True)
        }
    return found | {f"HiGS {tile}, {kind}": by_higs(tile, kind) for tile in (8, 16) for kind in ("none", "16b")}


def host_milliseconds(draw: Image) -> float:
    """The median time until a call on an idle device returns."""
    times = []
    for _ in range(REPEATS):
        torch.cuda.synchronize()
        begin = time.perf_counter()
        draw()
        times.append(1e3 * (time.perf_counter() - begin))
    return statistics.median(times)


def frames_a_second(draw: Image) -> float:
    """The rate of calls in a row, of which the host may run ahead."""
    torch.cuda.synchronize()
    begin = time.perf_counter()
    for _ in range(_IN_A_ROW):
        draw()
    torch.cuda.synchronize()
    return _IN_A_ROW / (time.perf_counter() - begin)


def load_scenes(args: argparse.Namespace) -> Iterator[tuple[str, SplatScene]]:
    """The workloads, or the models in all sizes, by name."""
    for workload in () if args.models else args.workloads:
        yield workload, sort_by_morton(frustum(*GPU_WORKLOADS[workload], device="cuda"))
    for folder in args.models:
        scene = load_trained(folder).to("cuda")
        made, count = scene.settings(torch.float32), len(scene.parameters["means"])
        for size in args.sizes:
            width, height = map(int, size.split("x"))
            camera = settings(
                width, height, torch.float32, view=made.viewmatrix.T.cpu(), fov=2 * math.atan(made.tanfovx)
            )
            yield f"{count / 1e6:.1f} M, {size}", replace(scene, width=width, height=height, camera=camera)


def main() -> None:
    """Print the times of all ways to draw the scenes' images, and how far the images differ."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--workloads", nargs="+", choices=GPU_WORKLOADS, default=list(GPU_WORKLOADS), help="(default: all)"
    )
    parser.add_argument("--models", type=Path, nargs="+", default=[], metavar="OUT", help="models of train.py instead")
    parser.add_argument("--sizes", nargs="+", default=["1920x1080", "3840x2160"], metavar="WxH", help="of these models")
    args = parser.parse_args()
    if not torch.cuda.is_available():
        raise UserError("this needs a GPU")
    try:
        import gsplat
    except ModuleNotFoundError as error:
        raise UserError(f"{error}; install gsplat 1.6") from error
    print(f"{describe_machine('cuda')}, gsplat {gsplat.__version__}", end="\n\n")
    rows = []
    with torch.no_grad():
        for workload, scene in load_scenes(args):
            wanted = None
            for name, make in make_draws(scene).items():
                try:
                    draw = make()
                    image = draw().float().clone()
                except Exception as error:  # of foreign code
                    print(f"{workload}, {name}: {error!r:.200}")
                    continue
                wanted = image if wanted is None else wanted
                psnr = -10 * (image - wanted).square().mean().log10().item()
                times = gpu_time(draw)
                rows.append(
                    [workload, name, *(f"{ms:.3f}" for ms in (times.events, times.kernels, host_milliseconds(draw)))]
                )
                rows[-1] += [f"{frames_a_second(draw):.0f}", f"{psnr:.1f}"]
                del draw
    print_table(["workload", "by", "events", "kernels", "host", "frames/s", "PSNR to ours"], rows)


if __name__ == "__main__":
    run_cli(main)
