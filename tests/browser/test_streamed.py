"""A streamed SOG in a real browser, over HTTP: PlayCanvas' viewer, as our pages have it, loads our levels."""

import gzip
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from gaussians import pipeline
from html_scene import SIZE, balls, cameras
from served_page import serving_folder
from tab_pictures import settled

from applications.export import html, streamed
from applications.export.formats import SceneInputs
from applications.export.levels import build_octree
from applications.export.sog import PROGRAM

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(not shutil.which(PROGRAM), reason=f"{PROGRAM} is not on PATH"),
]
WINDOW = SIZE
PAGE = """<!doctype html><link rel="icon" href="data:,"><body><script type="module">
import { createViewer } from './viewer.js';
const settings = await (await fetch('settings.json')).json();
window.viewer = await createViewer({ container: document.body, settings, contentUrl: 'lod-meta.json', noanim: true });
</script>"""


@pytest.fixture
def address(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A server of a streamed SOG of several levels, with the viewer."""
    monkeypatch.setattr(streamed, "build_octree", lambda some: build_octree(some, most=200))
    poses = html.poses_of(cameras())
    turn = html.turn_upright(html.find_up(poses))
    streamed.write_lod_meta(
        tmp_path / "lod-meta.json", html.rotated(balls(0), turn), SceneInputs((), (0, 0, 0), pipeline(), None, None)
    )
    settings = html.make_settings(poses, [str(k) for k in range(len(poses))], turn, None, (0.2, 0.4, 0.3), 3.0)
    (tmp_path / "settings.json").write_text(json.dumps(settings))
    (tmp_path / "viewer.js").write_bytes(gzip.decompress((html.FOLDER / html.VIEWER).read_bytes()))
    (tmp_path / "index.html").write_text(PAGE)
    with serving_folder(tmp_path) as where:
        yield f"{where}index.html"


def test_the_viewer_loads_the_levels(tab: "Page", address: str):
    asked = []
    tab.on("response", lambda answer: asked.append((answer.status, answer.url)))
    tab.goto(address)
    tab.wait_for_function("window.viewer?.state.loaded")
    shown = settled(tab)
    chunks = [url for _, url in asked if "/sog-" in url]
    assert chunks and {status for status, _ in asked} == {200}
    assert any(url.endswith("meta.json") for url in chunks) and any(url.endswith(".webp") for url in chunks)
    plain = np.abs(shown - shown[0, 0]).max(axis=2) < 8
    assert 0.05 < (~plain).mean() < 0.95, "the balls are not to be seen"
