"""Set up .venv and run the Python tests with nothing but Python: `make test` for systems that lack make.

python .ci/test_without_make.py [OPTION OF PYTEST...]

Lint and the C++ tests are left out; both need make.
"""

import argparse
import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VENV = ROOT / ".venv"
EXTENSIONS = sorted(path.parent.name for path in ROOT.glob("submodules/*/setup.py"))


def main() -> int:
    """Return the exit status of the first command that fails, or 0."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0], epilog="other options go to pytest")
    options = parser.parse_known_args()[1]
    python = VENV / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    if not python.exists():
        venv.create(VENV, with_pip=True)
    install = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    commands = [[*install, "-r", "requirements-dev.txt"]]
    commands += [[*install, "--no-deps", "--no-build-isolation", f"./submodules/{name}"] for name in EXTENSIONS]
    commands.append([python, "-m", "pytest", "-m", "not browser", "--numprocesses", "auto", *options])
    for command in commands:
        print("+", *command, flush=True)
        if status := subprocess.run(command, cwd=ROOT).returncode:
            return status
    return 0


if __name__ == "__main__":
    sys.exit(main())
