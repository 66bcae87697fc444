"""A streamed SOG in a real browser, over HTTP: PlayCanvas' viewer, as our pages have it, loads our levels."""

import gzip
import http.server
import io
import json
import shutil
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from gaussians import pipeline
from html_scene import SIZE, balls, cameras
from PIL import Image

from splatting.exports import html, streamed
from splatting.exports.formats import Around
from splatting.exports.levels import octree
from splatting.exports.sog import PROGRAM

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(not shutil.which(PROGRAM), reason=f"{PROGRAM} is not on PATH"),
]
WINDOW = SIZE
SECONDS = 60
PAGE = """<!doctype html><link rel="icon" href="data:,"><body><script type="module">
import { createViewer } from './viewer.js';
const settings = await (await fetch('settings.json')).json();
window.viewer = await createViewer({ container: document.body, settings, contentUrl: 'lod-meta.json', noanim: true });
</script>"""


@pytest.fixture
def address(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A server of a streamed SOG of several levels, with the viewer."""
    monkeypatch.setattr(streamed, "octree", lambda some: octree(some, most=200))
    poses = html.poses_of(cameras())
    turn = html.turn_upright(html.up_of(poses))
    streamed.write_lod_meta(
        tmp_path / "lod-meta.json", html.turned(balls(0), turn), Around((), (0, 0, 0), pipeline(), None, None)
    )
    settings = html.settings(poses, [str(k) for k in range(len(poses))], turn, None, (0.2, 0.4, 0.3), 3.0)
    (tmp_path / "settings.json").write_text(json.dumps(settings))
    (tmp_path / "viewer.js").write_bytes(gzip.decompress((html.FOLDER / html.VIEWER).read_bytes()))
    (tmp_path / "index.html").write_text(PAGE)
    handler = partial(http.server.SimpleHTTPRequestHandler, directory=tmp_path)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/index.html"
        server.shutdown()
        thread.join()


def test_the_viewer_loads_the_levels(tab: "Page", address: str):
    asked = []
    tab.on("response", lambda answer: asked.append((answer.status, answer.url)))
    tab.goto(address)
    tab.wait_for_function("window.viewer?.state.loaded", timeout=1000 * SECONDS)
    tab.wait_for_timeout(1000)
    chunks = [url for _, url in asked if "/sog-" in url]
    assert chunks and {status for status, _ in asked} == {200}
    assert any(url.endswith("meta.json") for url in chunks) and any(url.endswith(".webp") for url in chunks)
    shown = np.asarray(Image.open(io.BytesIO(tab.screenshot())).convert("RGB"), np.float64)
    plain = np.abs(shown - shown[0, 0]).max(axis=2) < 8
    assert 0.05 < (~plain).mean() < 0.95, "the balls are not to be seen"
