"""One-file HTML of a model in a real browser, opened from disk."""

import html
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from gaussians import pipeline
from html_page import Page as HtmlPage
from html_scene import FOV, SIZE, balls, cameras
from room_scene import HALF, STEP, room
from room_scene import cameras as in_room
from tab_pictures import BACKGROUND, SECONDS, expected, psnr, settled

from applications.export.html import write_html
from applications.export.walking import EYES, make_solid
from gaussian_renderer.camera_paths.poses import poses_of
from gaussian_renderer.camera_paths.start import narrow_fov
from gaussian_renderer.free_view import free_view

if TYPE_CHECKING:
    from playwright.sync_api import Frame, Page

pytestmark = pytest.mark.browser
WINDOW = SIZE
BARE = ".sse-viewer > :not(canvas), #about { display: none !important }"  # the picture without buttons


def show(tab: "Page", path: Path) -> None:
    """Open a page and wait for its first picture."""
    tab.goto(path.as_uri())
    wait_for_picture(tab)


def wait_for_picture(page: "Page | Frame") -> None:
    """Polls, as the page's policy forbids playwright's own way."""
    for _ in range(10 * SECONDS):
        if page.evaluate("window.viewer?.state?.loaded ?? false"):
            break
        page.wait_for_timeout(100)
    else:
        pytest.fail(f"no picture after {SECONDS} s: {page.locator('body').inner_text()}")
    page.add_style_tag(content=BARE)


@pytest.fixture(scope="module")
def splats():
    return balls()


@pytest.fixture(scope="module")
def page(splats, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("page") / "a model's page.html"
    write_html(path, splats, cameras(), background=BACKGROUND)
    return path


def test_the_page_begins_with_the_picture_of_its_first_camera(tab, page, splats):
    show(tab, page)
    shown = settled(tab)
    assert psnr(shown, expected(splats, cameras()[0])) > 33
    level = psnr(shown, expected(splats, cameras(rolls=())[0]))
    assert level < 27, "a camera that leans by 12 degrees makes no difference"


def test_a_frame_of_a_notebook_shows_the_page(tab, page, splats, tmp_path):
    """All of it stands in an attribute, so the frame has no address, and it may do nothing but run scripts.

    While the frame is hidden it has no size, by which the page would choose its opening angle.
    """
    style, text = "position: fixed; inset: 0; width: 100%; height: 100%; border: 0", page.read_text(encoding="utf-8")
    frame = f'<iframe hidden sandbox="allow-scripts" style="{style}" srcdoc="{html.escape(text)}"></iframe>'
    host = tmp_path / "notebook.html"
    host.write_text(f'<!DOCTYPE html><meta charset="utf-8"><link rel="icon" href="data:,">{frame}', encoding="utf-8")
    tab.goto(host.as_uri())
    tab.wait_for_timeout(500)
    tab.evaluate("document.querySelector('iframe').hidden = false")
    wait_for_picture(tab.frames[1])
    assert psnr(settled(tab), expected(splats, cameras()[0])) > 33
    link = tab.frames[1].locator(".sse-viewerBranding")
    assert link.get_attribute("href") and link.evaluate("e => getComputedStyle(e).display") == "none"


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (390, 844)])
def test_a_photo_fills_a_window_of_any_shape(browser, page, splats, width, height):
    """The margins above and below a wide photo fade on a phone; the help, which covers the model, begins closed."""
    phone = width < height
    context = browser.new_context(viewport={"width": width, "height": height}, has_touch=phone, is_mobile=phone)
    tab = context.new_page()
    show(tab, page)
    shown = settled(tab)
    camera = cameras()[0]
    fov, (position, turn) = narrow_fov(math.radians(FOV), SIZE[0] / SIZE[1], width / height), placed(camera)
    view = free_view(width, height, fov, position, turn, "cpu")
    assert psnr(shown, expected(splats, view)) > 31
    faded = tab.evaluate("[...document.querySelectorAll('.sse-sceneLayer > div')].map(e => e.style.background).join()")
    assert ("linear-gradient(0deg" in faded) == phone and ("linear-gradient(90deg" in faded) != phone
    assert tab.locator(".sse-controlsHint").evaluate("e => e.classList.contains('sse-hidden')")
    context.close()


def placed(camera) -> tuple[list[float], list[float]]:
    poses = poses_of([camera])
    return poses.positions[0].tolist(), poses.quaternions[0].tolist()


def place_of(tab: "Page") -> list[float]:
    return tab.evaluate("(({ x, y, z }) => [x, y, z])(viewer.app.root.findByName('camera').getPosition())")


def test_nobody_leaves_what_photos_show(tab, page):
    show(tab, page)
    tab.mouse.move(200, 150)
    places = []
    for _ in range(2):
        for _ in range(15):
            tab.mouse.wheel(0, 400)
            tab.wait_for_timeout(20)
        tab.wait_for_timeout(600)
        places.append(place_of(tab))
    least, most = json.loads(HtmlPage(page).texts["page"])["limits"]
    assert all(low - 1e-3 <= x <= high + 1e-3 for low, x, high in zip(least, places[1], most, strict=True))
    assert places[1] == pytest.approx(places[0], abs=1e-3) and math.dist(places[1], placed(cameras()[0])[0]) > 0.5
    tab.evaluate("viewer.state.cameraMode = 'fly'")
    for forward in (-1, 1):  # far out, and back, which begins at once
        tab.evaluate(f"viewer.setMoveInput(0, {forward})")
        tab.wait_for_timeout(1500)
        places.append(place_of(tab))
    assert all(low - 1e-3 <= x <= high + 1e-3 for low, x, high in zip(least, places[2], most, strict=True))
    assert math.dist(places[3], places[2]) > 0.3


def test_guests_walk_on_the_floor_and_stop_at_walls(tab, tmp_path):
    path = tmp_path / "room.html"
    write_html(path, room(), in_room(), upright=True, metric=True, solid=make_solid(room(), in_room(), pipeline()))
    show(tab, path)
    for _ in range(50):
        if tab.evaluate("viewer.state.walkAllowed"):
            break
        tab.wait_for_timeout(100)
    tab.evaluate("viewer.toggleWalk()")
    tab.wait_for_timeout(2000)
    _, on_floor, start = place_of(tab)
    tab.evaluate("viewer.setMoveInput(0, 1)")
    tab.wait_for_timeout(4000)
    _, on_step, wall = place_of(tab)
    assert start == pytest.approx(0, abs=0.05) and on_floor == pytest.approx(EYES, abs=0.06)
    assert on_step == pytest.approx(EYES + STEP[0], abs=0.12)
    assert HALF - 0.3 < abs(wall) < HALF - 0.15  # a walker has a radius of 0.2 m


def test_a_damaged_page_says_so(browser, page, tmp_path):
    text = page.read_text()
    start = text.index('id="viewer">') + len('id="viewer">')
    (tmp_path / "page.html").write_text(text[:start] + text[start + 1000 :])
    tab = browser.new_page()
    tab.goto((tmp_path / "page.html").as_uri())
    tab.get_by_text("The model cannot be shown").wait_for(timeout=1000 * SECONDS)
    tab.close()
