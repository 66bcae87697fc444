"""Commands and folders that serve a web page, and the page's fields, for tests in a browser."""

import http.server
import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
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


@contextmanager
def serving_folder(folder: Path) -> Iterator[str]:
    """The address of a folder, which ends with a slash."""
    handler = partial(http.server.SimpleHTTPRequestHandler, directory=folder)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/"
        finally:
            server.shutdown()
            thread.join()


def labelled(tab: "Page", label: str) -> "Locator":
    """The input beside a label."""
    return tab.locator(f'label:text-is("{label}")').locator("xpath=following::input[not(@type='hidden')][1]")
