"""Mean squared distance of each point to its three nearest others: `from simple_knn._C import distCUDA2`."""

import simple_knn.backend  # noqa: F401  (says whether torch is missing)
