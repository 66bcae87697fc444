"""Waits for a condition, with a limit that only a program that hangs reaches."""

import time
from collections.abc import Callable

LIMIT = 60.0  # seconds; a busy machine may take many times as long as an idle one


def wait_for(condition: Callable[[], object], seconds: float = LIMIT) -> None:
    """Wait until a condition holds; TimeoutError if it never does."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"not so after {seconds:g} s")
        time.sleep(0.002)
