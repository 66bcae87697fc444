"""The page of a saved model: frames are drawn when they are asked for."""

import argparse
import time

from scene.scene import Scene
from utils.host.interrupt import DeferredInterrupt
from viewing.options import Address
from viewing.page import Page

_BETWEEN = 1 / 60  # seconds from frame to frame, at least
_WAIT = 0.5  # seconds until a signal is noticed


def serve_saved(address: Address, scene: Scene, pipe: argparse.Namespace, white: bool, with_exposures: bool) -> None:
    """Serve the page until a signal comes, and raise that. white, with_exposures: as for `Page`."""
    page = Page(address, scene, pipe, white, with_exposures)
    try:
        with DeferredInterrupt() as interrupt:
            while not interrupt.requested:
                answer(page)
        raise interrupt.requested
    finally:
        page.stop()


def answer(page: Page) -> bool:
    """Draw and send the next frame that somebody waits for, or wait a little. Whether there was one."""
    wish = page.watchers.next()
    if wish is None:
        page.watchers.wait(_WAIT if not page.watchers.any else _BETWEEN)
        return False
    began = time.perf_counter()
    page.fulfil(wish)
    time.sleep(max(0.0, began + _BETWEEN - time.perf_counter()))
    return True
