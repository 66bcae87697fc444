"""`python -m tests.fuzz`: finds the modules of the project and of the tests, and starts."""

import importlib
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

if __name__ == "__main__":
    sys.exit(importlib.import_module("fuzz.command").main())
