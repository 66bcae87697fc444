"""--keep_best: the validation photos, the model that is kept, resumes, and what cannot be."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gaussians import pipeline
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio
from trainings import saved_plys, train_on

from arguments import GroupParams, read_stored_options
from gaussian_renderer import render
from gaussian_renderer.scored_views import ScoredViews
from scene.gaussians import density_rules
from scene.readers import info
from scene.saved_model import load_saved
from splatting.evaluation.training_log import read_log
from splatting.parts import check_together
from splatting.parts.keep_best.part import KeepBest
from splatting.parts.keep_best.validation import without_validation
from utils.system_utils import UserError

POINTS = 60, 85, 120, 170, 240
WORDS = ("--eval", "--no_curve", "--iterations", 240, "--disable_viewer", "--keep_unseen", "--quiet",
         "--densify_from_iter", 10, "--densification_interval", 100, "--densify_grad_threshold", 1e-5,
         "--opacity_reset_interval", 225, "--densify_until_iter", 230,
         "--save_iterations", *POINTS, "--checkpoint_iterations", 200)  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def late_resets():
    """A reset that leaves the end worse than the middle, which trainings otherwise leave out."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(density_rules, "reset_pays", lambda *_: True)
        yield


@pytest.fixture(scope="module")
def scene(_colmap_master: Path) -> Path:
    return _colmap_master


@pytest.fixture(scope="module")
def kept(scene, once) -> tuple[Path, dict[int, bytes]]:
    """A training that a late reset of the opacities leaves worse than it was, and its PLYs."""
    out = once("kept_best", lambda out: train_on(scene, out, *WORDS, "--keep_best"))
    return out, saved_plys(out)


def test_the_last_save_is_the_model_that_shows_the_validation_photos_best(kept, scene):
    out, plys = kept
    best = json.loads((out / "model.json").read_text())["kept_best"]
    scores = {r["iteration"]: r["validation_psnr"] for r in read_log(out / "train_log.json") if "validation_psnr" in r}
    assert best["iteration"] == max(scores, key=scores.get) == 170 and plys[240] == plys[170] != plys[120]
    loaded = load_saved(GroupParams(**read_stored_options(out)), 170)
    views = loaded.validation_cameras[1.0]
    assert [view.image_name for view in views] == best["views"] and len(best["views"]) == 2
    black, found = torch.zeros(3), []
    for view in views:
        with torch.no_grad():
            image = render(view, loaded.gaussians, pipeline(), black)["render"].permute(1, 2, 0).numpy()
        photo = np.asarray(Image.open(scene / "images" / view.image_name)) / 255
        found.append(peak_signal_noise_ratio(photo, image.astype(float), data_range=1.0))
    assert np.mean(found) == pytest.approx(scores[170], abs=1e-3) and best["psnr"] == scores[170]
    (line,) = (x for x in read_log(out / "train_log.json")[-1]["lines"] if x.startswith("--keep_best"))
    assert "saved the model of iteration 170" in line and f"{best['psnr'] - scores[240]:.2f} dB better" in line
    names = [camera["img_name"] for camera in json.loads((out / "cameras.json").read_text())]
    assert names[-2:] == best["views"] and len(names) == len(set(names)) == 17
    assert len(loaded.getTrainCameras()) == 12 and len(loaded.getTestCameras()) == 3
    elsewhere = load_saved(GroupParams(**read_stored_options(out) | {"other_scene": "scene"}), 170)
    assert len(elsewhere.getTrainCameras()) == 14 and not elsewhere.validation_cameras


def test_the_validation_and_the_test_photos_teach_nothing(kept, scene, tmp_path):
    out, plys = kept
    loaded = load_saved(GroupParams(**read_stored_options(out)), 240)
    trained = {camera.image_name for camera in loaded.getTrainCameras()}
    shutil.copytree(scene, tmp_path / "scene")
    for photo in (path for path in (tmp_path / "scene" / "images").rglob("*") if path.is_file()):
        if str(photo.relative_to(tmp_path / "scene" / "images")) not in trained:
            Image.new("RGB", (96, 64), "red").save(photo)
    others = train_on(tmp_path / "scene", tmp_path / "out", *WORDS, "--keep_best")
    assert all(others[t] == plys[t] for t in POINTS[:-1]) and others[240] != plys[240]  # reds choose otherwise


def test_a_resumed_training_knows_the_best_so_far(kept, scene, tmp_path):
    out, plys = kept
    start = "--start_checkpoint", out / "chkpnt200.pth"
    resumed = train_on(scene, tmp_path / "resumed", *WORDS, "--keep_best", *start)
    assert resumed[240] == plys[240]
    kinds = [json.loads((folder / "model.json").read_text())["kept_best"] for folder in (out, tmp_path / "resumed")]
    assert kinds[0] == kinds[1]
    train_on(scene, tmp_path / "plain", *WORDS)
    with pytest.raises(UserError, match="was trained on the photos that --keep_best holds out"):
        train_on(scene, tmp_path / "no", *WORDS, "--keep_best", start[0], tmp_path / "plain" / "chkpnt200.pth")
    for wrong, words in (
        ({"rows": {"xyz": torch.zeros(2, 2)}}, "xyz of the checkpoint has the shape"),
        ({"rows": {"xyz": torch.zeros(2, 3)}}, "is damaged"),
        *(({name: torch.tensor([1, 2])}, "is damaged") for name in ("iteration", "psnr", "degree")),
    ):
        state = torch.load(start[1], weights_only=False)
        best = state[0][10]["keep_best"]
        best |= wrong | {"rows": best["rows"] | wrong.get("rows", {})}
        torch.save(state, tmp_path / "chkpnt200.pth")
        with pytest.raises(UserError, match=words):
            train_on(scene, tmp_path / "no", *WORDS, "--keep_best", start[0], tmp_path / "chkpnt200.pth")


def test_a_validation_photo_that_is_shown_exactly_has_no_say(scene, tmp_path, monkeypatch):
    target = ScoredViews.target
    exact = iter([True, False] * 99)
    monkeypatch.setattr(ScoredViews, "compared", lambda views, camera, gaussians: (
        image := views.image(camera, gaussians), image if next(exact) else target(views, camera), None))  # fmt: skip
    train_on(scene, tmp_path, "-r", 4, "--eval", "--no_curve", "--iterations", 6, "--disable_viewer", "--quiet",
             "--test_iterations", -1, "--keep_best")  # fmt: skip
    best = json.loads((tmp_path / "model.json").read_text())["kept_best"]
    assert best["iteration"] == 6 and 5 < best["psnr"] < 99


@pytest.mark.parametrize(("count", "places"), [(8, (2, 6)), (31, (7, 22)), (43, (8, 24, 40))])
def test_every_sixteenth_view_validates_and_two_at_least(count, places):
    views = load_views(count)
    left = without_validation(views)
    chosen = left.validation_cameras
    assert [view.uid for view in chosen] == list(places) and all(v.is_test and not v.depth_path for v in chosen)
    assert [view.uid for view in left.train_cameras] == [n for n in range(count) if n not in places]


def load_views(count: int) -> info.SceneInfo:
    views = [info.CameraInfo(n, np.eye(3), np.zeros(3), 1, 1, width=9, height=9, depth_path="d") for n in range(count)]
    return info.SceneInfo(None, views, [], {"radius": 1.0}, None)


def test_what_cannot_be_is_refused_in_one_sentence(scene, tmp_path):
    with pytest.raises(UserError, match="needs at least 8 training photos, and there are 7; leave it out"):
        without_validation(load_views(7))
    for words in (("--refine_poses",), ("--appearance", "ppisp"), ("--train_test_exp",)):
        with pytest.raises(UserError, match=f"--keep_best does not work with {words[0]}"):
            train_on(scene, tmp_path, *WORDS, "--keep_best", *words)
    with pytest.raises(UserError, match="--keep_best needs a training of one process"):
        check_together([KeepBest()], SimpleNamespace(keep_best=True), several=True)
