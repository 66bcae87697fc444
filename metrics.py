"""Score rendered test views against their ground truth: PSNR, SSIM, LPIPS, DISTS and ST-LPIPS."""

if __name__ == "__main__":
    import groundwork.host.early  # noqa: F401  (before the other imports, which take a second)

import sys

from splatting.commands import metrics
from utils.system_utils import run_cli

if __name__ == "__main__":
    run_cli(metrics.main)
else:
    sys.modules[__name__] = metrics  # programs that import metrics.py may replace its functions
