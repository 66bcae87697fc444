"""A tab in a real Chromium, whose test fails for an error in it or a request to elsewhere."""

import shutil
from collections.abc import Iterator
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import pytest
from tab_pictures import SECONDS

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

PROGRAMS = ("chromium", "chromium-browser", "google-chrome")
# WebGL on the processor; without a sandbox, which containers do not allow.
OPTIONS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")

# What viser says of itself whenever somebody drags something in its picture.
OF_VISER = "Unable to preventDefault inside passive event listener invocation."


@pytest.fixture(scope="session")
def browser() -> "Iterator[Browser]":
    """A headless Chromium with software WebGL; skips where playwright or a Chromium is missing."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install playwright")
    program = next(filter(None, map(shutil.which, PROGRAMS)), None)
    if program is None:
        pytest.skip(f"none of {', '.join(PROGRAMS)} is on PATH: apt-get install chromium")
    with api.sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=program, args=list(OPTIONS))
        yield launched
        launched.close()


@pytest.fixture
def tab(browser: "Browser", request: pytest.FixtureRequest) -> "Iterator[Page]":
    """An empty tab of the module's WINDOW (width, height), with a memory of its own.

    It, its frames and its workers may ask nobody but the host of the page, or load one file.
    """
    width, height = request.module.WINDOW
    context = browser.new_context(viewport={"width": width, "height": height})
    context.set_default_timeout(1000 * SECONDS)
    page, errors, asked = context.new_page(), [], []
    page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("websocket", lambda socket: asked.append(socket.url))
    context.on("request", lambda asking: asked.append(asking.url))
    yield page
    context.close()
    assert not [error for error in errors if error != OF_VISER]
    loaded = [urlsplit(url) for url in asked if not url.startswith(("blob:", "data:", "about:"))]
    assert len({url.netloc for url in loaded}) == 1, asked
    assert sum(url.scheme == "file" for url in loaded) <= 1, asked
