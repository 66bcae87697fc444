"""Show a trained model on a web page that this process serves."""

if __name__ == "__main__":
    import groundwork.host.early  # noqa: F401  (before the other imports, which take a second)

import sys

from groundwork import applications
from utils.system_utils import run_cli

command = applications.command("viewer")

if __name__ == "__main__":
    run_cli(command.main)
else:
    sys.modules[__name__] = command  # programs that import view.py may replace its functions
