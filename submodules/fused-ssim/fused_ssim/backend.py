"""Loads the compiled operators."""

from pathlib import Path

_BUILD = "run `pip install ./submodules/fused-ssim` in the repository"
try:
    import torch

    from fused_ssim.operators import operators
except ModuleNotFoundError as error:
    if error.name != "torch":
        raise
    raise ImportError(f"fused_ssim needs torch: install it, then {_BUILD}") from error

_LIBRARY = Path(__file__).with_name("_backend.so")
try:
    torch.ops.load_library(_LIBRARY)
except OSError as error:
    what = f"does not fit torch {torch.__version__}" if _LIBRARY.exists() else "is not built"
    raise ImportError(f"fused_ssim {what}: {_BUILD}") from error

OPERATORS = operators("fused_ssim")
