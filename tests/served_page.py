"""A command that serves a web page, and the page's fields, for tests in a browser."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

ROOT = Path(__file__).resolve().parent.parent


@contextmanager
def serving(*words: object) -> Iterator[tuple[str, subprocess.Popen]]:
    """A command of this project that runs in another process: the address of its page, and the process."""
    environment = os.environ | {"OMP_NUM_THREADS": "1"}  # the browser needs a core, too
    streams = {"stderr": subprocess.PIPE, "stdout": subprocess.DEVNULL, "text": True}
    process = subprocess.Popen([sys.executable, *map(str, words)], cwd=ROOT, env=environment, **streams)
    try:
        said = ""
        while not (found := re.search(r"viewer: (http://\S+)", said)):
            line = process.stderr.readline()
            assert line, said
            said += line
        yield found[1], process
    finally:
        process.kill()
        process.wait()


def labelled(tab: "Page", label: str) -> "Locator":
    """The input beside a label."""
    return tab.locator(f'label:text-is("{label}")').locator("xpath=following::input[not(@type='hidden')][1]")
