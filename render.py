"""Render a trained model's train and test views as PNG beside the ground truth, and time the renders."""

if __name__ == "__main__":
    import groundwork.host.early  # noqa: F401  (before the other imports, which take a second)

import sys

from splatting.commands import render
from utils.system_utils import run_cli

if __name__ == "__main__":
    run_cli(render.main)
else:
    sys.modules[__name__] = render  # programs that import render.py may replace its functions
