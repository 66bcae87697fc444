"""Check that the installed extensions have the modules of this checkout. Import this module before them.

Without the check, a newer checkout ends in Python's own message about a missing name.
"""

import importlib.util
from pathlib import Path

_SOURCES = Path(__file__).resolve().parents[2] / "submodules"


def _check_extension() -> None:
    """Raise ImportError for an extension that is older than its sources here, or another project's of that name."""
    for sources in sorted(_SOURCES.glob("*/*/ops.py")):
        package, folder = sources.parent.name, sources.parents[1].name
        found = importlib.util.find_spec(package)
        if found is None or found.origin is None:
            continue
        installed = Path(found.origin).parent
        modules = *sources.parent.glob("*.py"), *_SOURCES.glob("common/package/*.py")
        lacking = [path.name for path in modules if not (installed / path.name).exists()]
        if lacking:
            raise ImportError(
                f"the installed {package} does not fit this checkout (it has no {min(lacking)}): "
                f"run `pip install ./submodules/{folder}` in the repository"
            )


_check_extension()
