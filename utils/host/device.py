"""The choice of the device that computes."""

import torch


def compute_device() -> torch.device:
    """`cuda` when a GPU is visible and the rasterizer was built with its CUDA kernels, else `cpu`.

    The rasterizer's library must be loaded before (gaussian_renderer does that), or it counts as built without CUDA.
    """
    return torch.device("cuda" if torch.cuda.is_available() and _has_cuda_kernels() else "cpu")


def _has_cuda_kernels() -> bool:
    loaded = hasattr(torch.ops.diff_gaussian_rasterization, "rasterize")
    return loaded and torch._C._dispatch_has_kernel_for_dispatch_key("diff_gaussian_rasterization::rasterize", "CUDA")
