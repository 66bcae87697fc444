"""Child processes that the terminal's Ctrl-C does not reach."""

import os
import subprocess
from typing import Any


def own_session() -> dict[str, Any]:
    """Options of subprocess.Popen that give the child a session of its own, on Windows a process group."""
    if os.name == "nt":
        return {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    return {"start_new_session": True}
