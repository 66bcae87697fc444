"""Error of every output and every gradient of the rasterizer against the float64 oracle.

    python benchmarks/accuracy.py

Error of a tensor = max |difference| / max |reference|, the median of |difference| / max |reference| beside it. Pixels
within 1e-4 of a cut-off (alpha 1/255, transmittance 1e-4) or under a depth tie, where rounding alone may decide, are
counted in their own column and left out of the loss and the comparison. The oracle gets the float32 values of every
parameter, so both dtypes answer the same question.
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import utils.openmp  # noqa: E402, F401  isort: skip  (before torch)
import torch
from diff_gaussian_rasterization import rasterize, reference

from benchmarks.environment import describe, print_table  # noqa: E402
from benchmarks.splat_scenes import KINDS, PARAMETERS, SplatScene  # noqa: E402

OUTPUTS = ("image", "inverse depth", "transmittance")


def errors(scene: SplatScene, dtype: torch.dtype, antialiasing: bool) -> tuple[dict[str, tuple[float, float]], int]:
    """(largest, median) error by name of output or gradient, and the number of pixels left out."""
    wanted, near = _run(scene, torch.float64, antialiasing, oracle=True)
    got, _ = _run(scene, dtype, antialiasing, oracle=False, keep=~near)
    result = {}
    for name, reference_value in wanted.items():
        difference = (got[name].double() - reference_value).abs()
        scale = reference_value.abs().max().clamp_min(1e-300)
        result[name] = (float(difference.max() / scale), float(difference.median() / scale))
    return result, int(near.sum())


def _run(
    scene: SplatScene, dtype: torch.dtype, antialiasing: bool, oracle: bool, keep: torch.Tensor | None = None
) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    leaves = scene.leaves(dtype)
    settings = scene.settings(torch.float64, antialiasing=antialiasing)
    means2d = torch.zeros_like(leaves["means"], requires_grad=True)
    arguments = {name: leaves[name] for name in ("scales", "rotations", "sh_dc", "sh_rest")} | {"raw": True}
    if oracle:
        out = reference.render(leaves["means"], means2d, leaves["opacities"], settings, **arguments)
        keep = ~out.near_cut
    else:
        out = rasterize(
            leaves["means"],
            means2d,
            leaves["opacities"],
            settings,
            **arguments,
            want_inverse_depth=True,
            want_transmittance=True,
        )
    planes = [out.color, out.inverse_depth, out.transmittance]
    generator = torch.Generator().manual_seed(7)
    weights = [torch.randn(plane.shape, generator=generator, dtype=torch.float64).to(plane.dtype) for plane in planes]
    sum((plane * weight * keep).sum() for plane, weight in zip(planes, weights, strict=True)).backward()
    tensors = {name: (plane * keep).detach() for name, plane in zip(OUTPUTS, planes, strict=True)}
    tensors |= {f"d {name}": leaves[name].grad for name in PARAMETERS} | {"d screen mean": means2d.grad[:, :2]}
    return tensors, ~keep


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--antialiasing", action="store_true", help="measure with antialiasing")
    args = parser.parse_args()
    print(describe())
    columns = [(kind, dtype) for kind in KINDS for dtype in (torch.float32, torch.float64)]
    measured = {column: errors(KINDS[column[0]](), column[1], args.antialiasing) for column in columns}
    header = ["", *(f"{kind}, {str(dtype).removeprefix('torch.')}" for kind, dtype in columns)]
    names = measured[columns[0]][0]
    rows = [[name, *("{:.1e} ({:.0e})".format(*measured[column][0][name]) for column in columns)] for name in names]
    rows.append(["pixels left out", *(str(measured[column][1]) for column in columns)])
    print_table(header, rows)


if __name__ == "__main__":
    main()
