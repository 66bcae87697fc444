"""Programs of gsplat on this rasterizer, unedited: `import gsplat` finds our `rasterization`.

Without a GPU, two helpers of gsplat's MCMC strategy are computed by PyTorch, as gsplat has kernels alone for them.
"""

import os
import runpy
import sys
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from diff_gaussian_rasterization.gsplat import rasterization


def install() -> None:
    """Let `import gsplat` find our function: in gsplat, if it is installed, else in a module of that name."""
    try:
        import gsplat
        import gsplat.rendering as rendering
    except ModuleNotFoundError as error:
        if error.name not in ("gsplat", "gsplat.rendering"):
            raise  # gsplat is there, and lacks something
        gsplat, rendering = ModuleType("gsplat"), ModuleType("gsplat.rendering")
        gsplat.rendering = rendering
        sys.modules.update({"gsplat": gsplat, "gsplat.rendering": rendering})
    version = [int(part) for part in getattr(gsplat, "__version__", "1.5").split(".")[:2]]
    gsplat.rasterization = rendering.rasterization = rasterization if version >= [1, 5] else with_one_radius
    if hasattr(gsplat, "strategy") and not torch.cuda.is_available():
        gsplat.strategy.ops.compute_relocation = relocated
        gsplat.strategy.ops.quat_scale_to_covar_preci = gsplat.cuda._torch_impl._quat_scale_to_covar_preci


def with_one_radius(*inputs: Any, **options: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """`rasterization` for gsplat before 1.5, whose strategies read one radius of a Gaussian, not two."""
    image, alpha, meta = rasterization(*inputs, **options)
    return image, alpha, meta | {"radii": meta["radii"].amax(-1)}


def relocated(
    opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor, min_opacity: float = 0.005
) -> tuple[Tensor, Tensor]:
    """Opacities (N,) and scales (N, 3) of each of the equal parts that Gaussians are replaced by.

    ratios (N,): how many parts. binoms (n, n): binomial coefficients, of which the number limits the parts.
    min_opacity: of a part, with which its scales are found. The parts' rule is equation 9 of Kheradmand et al. 2024;
    its inner sums of binomials are added up to those of one row more.
    """
    most = len(binoms)
    count = ratios.clamp(1, most).long()
    parts = (1 - (1 - opacities.double()) ** (1 / count.double())).clamp(min_opacity, 1 - 2.0**-23)
    k = torch.arange(1, most + 1, device=opacities.device).double()
    above, below = count[:, None].double(), count[:, None] - k
    choose = (torch.lgamma(above + 1) - torch.lgamma(k + 1) - torch.lgamma(below.clamp_min(0) + 1)).exp().round()
    terms = torch.where(below >= 0, choose * (-1) ** (k - 1) * parts[:, None] ** k / k.sqrt(), 0)
    factor = opacities.double() / terms.sum(1)
    return parts.to(opacities), (scales.double() * factor[:, None]).to(scales)


def run() -> None:
    """Run the program that the command line names, with its options, after `install`."""
    if len(sys.argv) < 2:
        sys.exit("name a program: python -m diff_gaussian_rasterization.gsplat PROGRAM.py [OPTION...]")
    if not os.path.exists(sys.argv[1]):
        sys.exit(f"there is no program {sys.argv[1]}")
    install()
    del sys.argv[0]
    sys.path[0] = os.path.dirname(os.path.abspath(sys.argv[0]))  # as python PROGRAM.py does
    runpy.run_path(sys.argv[0], run_name="__main__")
