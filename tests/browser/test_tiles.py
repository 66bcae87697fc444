"""Tilesets in a real browser: 3d-tiles-renderer with three.js, and CesiumJS, load and show our tiles.

They come from npm: `npm ci --ignore-scripts` in this folder installs the versions of its lock file.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from gaussians import pipeline
from html_scene import FOV, SIZE, balls, cameras
from served_page import serving_folder
from tab_pictures import BACKGROUND, expected, psnr, settled

from applications.export import tiles3d
from applications.export.formats import SceneInputs, find_format
from applications.export.levels import Tile, build_octree, join_splats
from gaussian_renderer.camera_paths.poses import poses_of
from scene.splats.splats import Splats

if TYPE_CHECKING:
    from playwright.sync_api import Page

HERE = Path(__file__).parent
MODULES = HERE / "node_modules"
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(not MODULES.is_dir(), reason=f"no viewer; run npm ci --ignore-scripts in {HERE.name}"),
]
WINDOW = SIZE
MOST = 40  # Gaussians of a leaf
# dB. The viewer ends Gaussians at 2 standard deviations (we where they are below 1/255), rounds SH coefficients to 8
# bits, and sorts each tile's Gaussians for themselves: 33.7 are left. With conjugate quaternions 28.2 would be, with
# logits of opacities 29.6, and with SH coefficients in another order 32.0.
LEAST = 32.5
LEAST_OF_CESIUM = 48.0  # which sorts all Gaussians together and ends none early; 50.6 and 53.1 of SPZ with its 8 bits


def needles() -> Splats:
    """Two balls of long Gaussians, with clear view dependence, and colours that need no clipping."""
    some = balls(1)
    rng = np.random.default_rng(5)
    sh = some.sh * np.float32([[[0.6], [2.5], [2.5], [2.5]]])
    scales = np.log([0.16, 0.05, 0.03]) + rng.normal(scale=0.2, size=(len(some), 1))
    return replace(some, log_scales=scales.astype(np.float32), sh=sh, opacity_logits=1.5 * some.opacity_logits - 1)


def in_tiles(camera) -> list[float]:
    """A camera's pose as three.js has it, in the axes of tiles: 16 numbers by columns.

    A GLB has y up, and tiles z up; three.js' cameras look along -z, with y up.
    """
    poses, pose = poses_of([camera]), np.eye(4)
    axes = np.float64([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # x right, y down, z forward of the scene to z up
    pose[:3, :3] = axes @ poses.turns[0] @ np.diag([1, -1, -1])
    pose[:3, 3] = axes @ poses.positions[0]
    return pose.T.ravel().tolist()


def show(
    tab: "Page", folder: Path, some: Splats, camera, error: float, kind: str = "tileset"
) -> tuple[np.ndarray, list[Tile], set[str]]:
    """The picture of a tileset, which `folder` gets, the tiles in it, and the names of those that were loaded.

    error: that the viewer allows, pixels. kind: of a page beside this file, and of the tileset that it shows.
    """
    asked = []
    tab.on("response", lambda answer: asked.append((answer.status, Path(answer.url))))
    find_format(f"{kind}.json").write(folder / f"{kind}.json", some, SceneInputs((), BACKGROUND, pipeline()))
    view = {"width": SIZE[0], "height": SIZE[1], "fov": FOV, "camera": in_tiles(camera), "error": error}
    view |= {"background": BACKGROUND, "place": some.place}
    (folder / "view.json").write_text(json.dumps(view))
    (folder / "index.html").symlink_to(HERE / f"{kind}.html")
    (folder / MODULES.name).symlink_to(MODULES)
    with serving_folder(folder) as address:
        tab.goto(f"{address}index.html")
        tab.wait_for_function("window.loaded")
        shown = settled(tab)
        assert tab.evaluate("failed") == []
        names = {Path(uri).stem for uri in tab.evaluate("visible()")}
        tab.goto("about:blank")  # which asks the server for nothing more
    assert {status for status, _ in asked} == {200}
    loaded = {path.stem for _, path in asked if path.suffix == ".glb"}
    return shown, [tile for tile in build_octree(some, MOST).all() if tile.name in names], loaded


def level(shown: np.ndarray, some: Splats, camera) -> float:
    """PSNR of a picture to our render, dB; `pytest -s` prints it."""
    found = psnr(shown, expected(some, camera))
    print(f"{found:.1f} dB to our render")
    return found


@pytest.fixture(autouse=True)
def small_leaves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiles3d, "build_octree", lambda some: build_octree(some, MOST))


@pytest.mark.parametrize(
    ("error", "coarse"),
    [
        pytest.param(100, {"r"}, id="coarsest"),
        pytest.param(10.8, {"r0", "r2", "r3", "r4", "r5", "r7"}, id="two levels"),
        pytest.param(1, {"r0", "r3", "r4", "r5", "r7"}, id="finest"),  # leaves, as r2 is not
    ],
)
def test_the_viewer_shows_the_levels_that_it_needs(tab, tmp_path, error, coarse):
    """coarse: the tiles in the picture above the finest level."""
    some, camera = needles(), cameras()[0]
    shown, tiles, loaded = show(tab, tmp_path, some, camera, error)
    names = {tile.name for tile in tiles}
    assert {name for name in names if len(name) < 3} == coarse and {"r", *names} <= loaded
    together = join_splats([tile.splats for tile in tiles])
    assert (len(together) == len(some)) == (error == 1)
    assert level(shown, together, camera) > LEAST


def test_cesium_shows_a_coarse_level(tab, tmp_path):
    some, camera = needles(), cameras()[0]
    shown, tiles, loaded = show(tab, tmp_path, some, camera, 100, "cesium")
    assert [tile.name for tile in tiles] == ["r"] and loaded == {"r"}
    assert level(shown, tiles[0].splats, camera) > LEAST_OF_CESIUM


@pytest.mark.parametrize(("kind", "least"), [("tileset", LEAST), ("cesium", LEAST_OF_CESIUM)])
def test_the_viewer_finds_the_model_on_the_globe(tab, tmp_path, kind, least):
    """Its camera stands where its own formulas have the place."""
    some, camera = replace(needles(), place=(47.25, 8.5, 410.0)), cameras()[0]
    shown, tiles, _ = show(tab, tmp_path, some, camera, 1, kind)
    assert sum(len(tile.splats) for tile in tiles) == len(some)
    assert level(shown, some, camera) > least
