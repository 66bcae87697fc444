"""Loads the compiled operators, and tells the devices that they were built for."""

from pathlib import Path

_BUILD = "run `pip install ./submodules/diff-gaussian-rasterization` in the repository"
try:
    import torch

    from diff_gaussian_rasterization.operators import operators
except ModuleNotFoundError as error:
    if error.name != "torch":
        raise
    raise ImportError(f"diff_gaussian_rasterization needs torch: install it, then {_BUILD}") from error

_LIBRARY = Path(__file__).with_name("_backend.so")
try:
    torch.ops.load_library(_LIBRARY)
except OSError as error:
    what = f"does not fit torch {torch.__version__}" if _LIBRARY.exists() else "is not built"
    raise ImportError(f"diff_gaussian_rasterization {what}: {_BUILD}") from error

OPERATORS = operators("diff_gaussian_rasterization")


def has_cuda_kernels() -> bool:
    """Whether this build has the CUDA backend. A GPU may be missing all the same: see torch.cuda.is_available()."""
    return torch._C._dispatch_has_kernel_for_dispatch_key("diff_gaussian_rasterization::rasterize", "CUDA")
