"""The start of a page: first view, title and picture, and the cleaning."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from gaussians import pipeline
from html_page import Page
from html_scene import FOV, SIZE, balls, cameras
from PIL import Image

import export
import train
from applications.export import cleaning
from applications.export.formats import SceneInputs, find_format
from applications.export.page_start import PICTURE, find_named, write_preview
from gaussian_renderer import render
from gaussian_renderer.camera_paths import without_scene
from gaussian_renderer.camera_paths.poses import Poses, poses_of
from gaussian_renderer.camera_paths.start import LEAST, MOST, best_start, narrow_fov
from gaussian_renderer.free_view import free_view
from scene.with_splats import model_of
from utils.system_utils import UserError


def _meta(page: Path) -> dict[str, str]:
    return {
        attributes.get("property") or attributes.get("name"): attributes.get("content")
        for tag, attributes in Page(page).tags
        if tag == "meta"
    }


def test_a_page_begins_at_a_usual_camera_that_looks_at_the_middle():
    poses = poses_of(cameras(8))
    assert best_start(poses) == 0  # all are alike
    turns, places = poses.turns.copy(), poses.positions.copy()
    turns[:3] = turns[:3] @ np.array([[[0.9, 0, 0.435889894], [0, 1, 0], [-0.435889894, 0, 0.9]]])  # look aside
    middle = places.mean(0)
    places[3] = middle + 3 * (places[3] - middle)
    assert best_start(Poses(places, turns, poses.fov)) >= 4
    assert best_start(poses[np.array([0])]) == 0  # looks at nothing in common


def test_a_start_is_named_with_or_without_its_ending():
    names = [f"photo_{n}.jpg" for n in range(8)]
    assert find_named("photo_3.jpg", names, "") == find_named("photo_3", names, "") == 3
    with pytest.raises(UserError, match=r"--start photo is no training photo; there are photo_0.jpg, .* and 3 more"):
        find_named("photo", names, "--start photo")


@pytest.mark.parametrize(
    ("photo", "window", "heights"),
    [
        (1.5, 1.5, 1),
        (1.5, 1.6, 1.5 / 1.6),  # fills the width
        (0.5, 2.0, LEAST),
        (1.5, 1.3, 1),  # fills the height
        (1.5, 0.75, LEAST * 2),
        (1.5, 390 / 844, MOST),  # a phone
        (0.75, 390 / 844, LEAST * 0.75 * 844 / 390),
        (0.4, 0.5, LEAST),
    ],
)
def test_a_photo_fills_a_window_unless_that_hides_much_of_it(photo, window, heights):
    assert math.tan(narrow_fov(math.radians(40), photo, window) / 2) == pytest.approx(
        heights * math.tan(math.radians(20))
    )


def test_the_picture_beside_a_link_is_the_first_one(tmp_path):
    splats, camera = balls(), cameras(rolls=())[2]
    write_preview(tmp_path / "page.jpg", splats, camera, pipeline(), (0.2, 0.4, 0.3))
    shown = np.asarray(Image.open(tmp_path / "page.jpg"), np.float64)
    assert shown.shape == (*PICTURE[::-1], 3)
    poses, fov = poses_of([camera]), narrow_fov(math.radians(FOV), SIZE[0] / SIZE[1], PICTURE[0] / PICTURE[1])
    view = free_view(*PICTURE, fov, poses.positions[0].tolist(), poses.quaternions[0].tolist(), "cpu")
    with torch.no_grad():
        image = render(view, model_of(splats), pipeline(), torch.tensor([0.2, 0.4, 0.3]))["render"]
    assert np.abs(shown - 255 * image.clamp(0, 1).permute(1, 2, 0).numpy()).mean() < 2


def test_a_title_is_text_whatever_it_holds(tmp_path):
    title = "<script>alert(1)</script> & \"quotes'"
    around = SceneInputs(cameras(), (0.0, 0.0, 0.0), pipeline(), None, None, "photo_5", title)
    path = tmp_path / "my page #1.html"  # a photo "my page #1.jpg" beside it would stay
    find_format(path).write(path, balls(), around)
    page, meta = Page(path), _meta(path)
    assert page.texts["title"] == meta["og:title"] == title and "alert(1)</script>" not in path.read_text()
    assert meta["og:type"] == "website" and meta["og:image"] == "my%20page%20%231.html.jpg"
    assert sorted(file.name for file in tmp_path.iterdir()) == ["my page #1.html", "my page #1.html.jpg"]


def test_pages_are_cleaned_unless_they_are_raw(colmap_scene, tmp_path, monkeypatch, capsys):
    asked = []

    def clean_scene(scene, most, pipe, white):
        asked.append(most)
        raise UserError("enough is known")

    monkeypatch.setattr(export, "clean_scene", clean_scene)
    model = tmp_path / "model"
    train.main(["-s", str(colmap_scene), "-m", str(model), "--iterations", "2", "--disable_viewer", "--quiet"])

    def run(*words: str, to: str = "page.html") -> None:
        monkeypatch.setattr("sys.argv", ["export.py", "-m", str(model), "--to", str(tmp_path / to), *words])
        export.main()

    for picture in ("page.html.jpg", "page.html.removed.png"):
        (tmp_path / picture).write_bytes(b"mine")
        with pytest.raises(UserError, match=f"no export wrote .*{picture} as it is, .* replace it; move"):
            run()
        assert (tmp_path / picture).read_bytes() == b"mine" and not asked
        (tmp_path / picture).unlink()
    for words, most in (((), cleaning.OPTION["const"]), (("--clean", "0.2"), 0.2)):
        with pytest.raises(UserError, match="enough is known"):
            run(*words)
        assert asked.pop() == most
    for words, said in (
        ("--start nowhere", "--start nowhere is no training photo"),  # before the views are rendered
        ("--path spiral", "--path"),
        ("--raw --clean", "contradict"),
    ):
        with pytest.raises(UserError, match=said):
            run(*words.split())
    with pytest.raises(UserError, match=r"--title is for \.html"):
        run("--title", "Room", to="a.ply")
    capsys.readouterr()
    run("--raw", "--title", "Room")
    assert "warning" not in capsys.readouterr().err
    assert not asked and (tmp_path / "page.html.jpg").is_file() and _meta(tmp_path / "page.html")["og:title"] == "Room"
    monkeypatch.setattr(without_scene, "have_moved", lambda *_: True)
    run("--raw")
    assert "warning: the scene's poses are not those that" in capsys.readouterr().err
