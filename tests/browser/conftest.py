"""Fixtures for tests in a real Chromium: the browser, a tab, and what goes wrong or out in it."""

import shutil
from collections.abc import Iterator
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

PROGRAMS = ("chromium", "chromium-browser", "google-chrome")
# WebGL on the processor; without a sandbox, which containers do not allow.
OPTIONS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
SIZE = {"width": 900, "height": 600}


def chromium() -> str | None:
    """The path of a Chromium, None if there is none."""
    return next(filter(None, map(shutil.which, PROGRAMS)), None)


@pytest.fixture(scope="session")
def browser() -> "Iterator[Browser]":
    """A headless Chromium with software WebGL; skips where playwright or a Chromium is missing."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install playwright")
    program = chromium()
    if program is None:
        pytest.skip(f"none of {', '.join(PROGRAMS)} is on PATH: apt-get install chromium")
    with api.sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=program, args=list(OPTIONS))
        yield launched
        launched.close()


@pytest.fixture
def tab(browser: "Browser") -> "Iterator[Page]":
    """An empty tab of 900 x 600 pixels with a memory of its own."""
    context = browser.new_context(viewport=SIZE)
    yield context.new_page()
    context.close()


@pytest.fixture
def page_errors(tab: "Page") -> list[str]:
    """Errors of the tab's console and uncaught exceptions, as they come."""
    errors: list[str] = []
    tab.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    tab.on("pageerror", lambda error: errors.append(str(error)))
    return errors


@pytest.fixture
def requests(tab: "Page") -> list[str]:
    """The address of everything that the tab, its frames and its workers ask for, websockets among them."""
    asked: list[str] = []
    tab.context.on("request", lambda request: asked.append(request.url))
    tab.on("websocket", lambda socket: asked.append(socket.url))
    return asked


def outside(addresses: list[str], own: str = "") -> list[str]:
    """Those addresses that lie neither in the page itself nor at the host and port `own`."""
    return [
        address
        for address in addresses
        if not address.startswith(("blob:", "data:", "about:")) and urlsplit(address).netloc != own
    ]
