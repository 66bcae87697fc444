"""Loads the compiled operators."""

from pathlib import Path

_BUILD = "run `pip install ./submodules/simple-knn` in the repository"
try:
    import torch

    from simple_knn.operators import operators
except ModuleNotFoundError as error:
    if error.name != "torch":
        raise
    raise ImportError(f"simple_knn needs torch: install it, then {_BUILD}") from error

_LIBRARY = Path(__file__).with_name("_backend.so")
try:
    torch.ops.load_library(_LIBRARY)
except OSError as error:
    what = f"does not fit torch {torch.__version__}" if _LIBRARY.exists() else "is not built"
    raise ImportError(f"simple_knn {what}: {_BUILD}") from error

OPERATORS = operators("simple_knn")
