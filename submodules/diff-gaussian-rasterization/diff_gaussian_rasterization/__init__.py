"""Differentiable rasterizer for 3D Gaussian Splatting: the reference's API, and `rasterize`, which it wraps.

`optim` has the optimiser's kernels and `reference` the oracle.
"""

import diff_gaussian_rasterization.backend  # noqa: F401  (first, because it says whether torch is missing)

import diff_gaussian_rasterization._C  # noqa: F401  isort: skip  (clients take it as an attribute)
from diff_gaussian_rasterization.gaussians import Gaussians
from diff_gaussian_rasterization.ops import Rasterized, decisive, has_cuda_kernels, rasterize
from diff_gaussian_rasterization.rasterizer import GaussianRasterizer, cpu_deep_copy_tuple, rasterize_gaussians
from diff_gaussian_rasterization.settings import GaussianRasterizationSettings
from diff_gaussian_rasterization.sparse_adam import SparseGaussianAdam

__all__ = [
    "GaussianRasterizationSettings",
    "GaussianRasterizer",
    "Gaussians",
    "Rasterized",
    "SparseGaussianAdam",
    "cpu_deep_copy_tuple",
    "decisive",
    "has_cuda_kernels",
    "rasterize",
    "rasterize_gaussians",
]
