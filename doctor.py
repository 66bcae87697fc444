"""Check the environment, a dataset and a trained model; print each problem and its remedy in one line."""

if __name__ == "__main__":
    import groundwork.host.early  # noqa: F401  (before the other imports, which take a second)

import sys

from groundwork import applications

command = applications.command("doctor")

if __name__ == "__main__":
    command.run()
else:
    sys.modules[__name__] = command  # programs that import doctor.py may replace its functions
