"""`distCUDA2` under the name by which the reference's users import it."""

from simple_knn.ops import distCUDA2

__all__ = ["distCUDA2"]
