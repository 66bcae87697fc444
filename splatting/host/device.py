"""The choice of the device that computes. torch is imported on first use: not every program needs it."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch


def compute_device() -> torch.device:
    """`cuda` when a GPU is visible and the rasterizer was built with its CUDA kernels, else `cpu`."""
    import torch

    return torch.device("cuda" if torch.cuda.is_available() and _has_cuda_kernels() else "cpu")


def _has_cuda_kernels() -> bool:
    try:
        from diff_gaussian_rasterization import has_cuda_kernels
    except ImportError:  # metrics.py and doctor.py work without the extension
        return False
    return has_cuda_kernels()
