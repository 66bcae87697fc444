"""Train a Gaussian model: photos with cameras and sparse points in, point_cloud.ply out."""

if __name__ == "__main__":
    import groundwork.host.early  # noqa: F401  (before the other imports, which take a second)
    import groundwork.host.early_cuda  # noqa: F401  (while the others are imported)

import sys

from splatting.commands import train
from utils.system_utils import run_cli

if __name__ == "__main__":
    run_cli(train.main, several=True)
else:
    sys.modules[__name__] = train  # programs that import train.py may replace its functions
