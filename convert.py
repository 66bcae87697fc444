"""Convert photos or a video to a scene for train.py: camera poses, points, photos that it can show."""

if __name__ == "__main__":
    import groundwork.host.early  # noqa: F401  (before the other imports, which take a second)

import sys

from groundwork import applications
from utils.system_utils import run_cli

command = applications.command("convert")

if __name__ == "__main__":
    run_cli(command.main)
else:
    sys.modules[__name__] = command  # programs that import convert.py may replace its functions
