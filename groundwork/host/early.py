"""`start.prepare()` on import. A command imports this first, and only where it is the program itself."""

import importlib.util
import sys

from groundwork.host.start import prepare

if importlib.util.find_spec("torch") is None and not sys.argv[0].endswith(("doctor.py", "convert.py")):
    print(f"error: {sys.executable} has no torch; run make install, then .venv/bin/python", *sys.argv, file=sys.stderr)
    sys.exit(2)
prepare()
