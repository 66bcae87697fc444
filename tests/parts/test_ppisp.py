"""The appearance of photos (--appearance): its formulas, gauge, file, fits to halves of photos, and trainings."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gaussians import options
from PIL import Image
from scipy.optimize import minimize
from skimage.metrics import peak_signal_noise_ratio
from synthetic import make_blender_scene, make_colmap_scene, options_of
from trainings import train_on, trained

import metrics
import render
from applications.evaluation.plan import Run, SceneEntry
from applications.evaluation.results import read_run
from gaussian_renderer.scored_views import has_trained_exposure
from scene.gaussian_model import GaussianModel
from scene.readers.tracks import PhotoPoints
from scene.saved_model import load_saved
from scene.scene import Scene
from splatting.features.ppisp import exposures
from splatting.features.ppisp_appearance import NAME, PhotoAppearance, appearance_of, read_appearance
from utils.system_utils import UserError

SIDE = 20
NAMES, CAMERAS = ["b.png", "a.png", "c.png"], [4, 7, 4]
VIEWS = [SimpleNamespace(image_name=name, uid=camera) for name, camera in zip(NAMES, CAMERAS, strict=True)]


def _random(seed: int = 0, size: float = 0.5) -> PhotoAppearance:
    appearance, generator = PhotoAppearance(NAMES, CAMERAS), torch.Generator().manual_seed(seed)
    for values in appearance.numbers.values():
        values.copy_(size * torch.randn(values.shape, generator=generator))
    return appearance


def _by_definition(image: np.ndarray, photo: np.ndarray, camera: dict[str, np.ndarray]) -> np.ndarray:
    """The formulas of PhotoAppearance by channel and pixel, with the curve as a Bernstein polynomial."""
    exposure, red, others = photo
    gains, (_, height, width) = (exposure + red + others, exposure - 2 * others, exposure - red + others), image.shape
    seen = np.empty_like(image)
    for k, row, column in np.ndindex(image.shape):
        place = np.array([column + 0.5 - width / 2, row + 0.5 - height / 2]) / (np.hypot(width, height) / 2)
        square = ((place - camera["middle"]) ** 2).sum()
        a, b = camera["vignetting"][k]
        x = image[k, row, column] * 2 ** (gains[k] + a * square + 3 * b * square * (square - 0.5))
        rises = np.exp(camera["response"][k]) / np.exp(camera["response"][k]).sum()
        s, (c1, c2) = min(max(x, 0), 1), np.cumsum(rises)[:2]
        seen[k, row, column] = x - s + 3 * (1 - s) ** 2 * s * c1 + 3 * (1 - s) * s**2 * c2 + s**3
    return seen


def test_a_photo_is_what_the_formulas_say():
    appearance, image = _random(), 1.6 * torch.rand(3, 5, 8, generator=torch.Generator().manual_seed(1)) - 0.2
    photos, *numbers = (values.double().numpy() for values in appearance.numbers.values())
    rows = [0, 1, 0]
    for index, (name, row) in enumerate(zip(NAMES, rows, strict=True)):
        camera = {kind: values[row] for kind, values in zip(("vignetting", "middle", "response"), numbers, strict=True)}
        camera["response"] = camera["response"] - numbers[2][rows].mean(0)
        expected = _by_definition(image.double().numpy(), photos[index] - photos.mean(0), camera)
        np.testing.assert_allclose(appearance.shown(image, name).numpy(), expected, atol=2e-6)


def test_gradients_are_those_of_differences():
    appearance, generator = _random(), torch.Generator().manual_seed(1)
    image = torch.rand(3, 4, 5, dtype=torch.float64, generator=generator).requires_grad_()
    numbers = {name: values.double().requires_grad_() for name, values in appearance.numbers.items()}

    def shown(image: torch.Tensor, *values: torch.Tensor) -> torch.Tensor:
        appearance.numbers = dict(zip(numbers, values, strict=True))
        return appearance.shown(image, "a.png")

    photos, vignetting, middle, response = numbers.values()
    photos, response = photos.detach(), response.detach()
    assert torch.autograd.gradcheck(
        lambda *some: shown(some[0], photos, *some[1:], response), (image, vignetting, middle)
    )
    # A mean over photos counts as a constant, as if it were taken out after each step: other rows make up for it here.
    for name in ("photos", "response"):
        values, step = numbers[name], 1e-5
        (gradient,) = torch.autograd.grad(shown(image, *numbers.values()).sum(), values)
        assert gradient[1].any() and not gradient[0].any()
        change = torch.zeros_like(values)
        for place in np.ndindex(values.shape[1:]):
            change[(1, *place)], change[(0, *place)] = step, -step / (2 if name == "response" else 1)
            ends = [numbers | {name: values.detach() + sign * change} for sign in (1, -1)]
            up, down = (shown(image, *end.values()).sum().item() for end in ends)
            assert gradient[(1, *place)].item() == pytest.approx((up - down) / (2 * step), rel=1e-5, abs=1e-8)
            change.zero_()


def test_photos_count_from_their_mean_after_every_step_and_nothing_is_learnt_while_held():
    appearance = _random()
    appearance.training_setup(options(iterations=10))
    for step in range(1, 6):
        appearance.held = step > 3
        appearance.update_learning_rate(step)
        before = {name: values.detach().clone() for name, values in appearance.numbers.items()}
        (appearance.shown(torch.rand(3, 4, 5), NAMES[step % 3]).sum() + appearance.size_penalty("a.png")).backward()
        appearance.step()
        for name, values in appearance.numbers.items():
            assert torch.equal(values, before[name]) == (step > 3), (step, name)
        slopes = appearance.numbers["vignetting"] @ torch.tensor([[1.0, 1.0], [-1.5, 4.5]])  # in the middle, in corners
        assert slopes.max() <= 1e-6
        assert torch.stack([appearance.photo(name) for name in NAMES]).mean(0).abs().max() < 1e-6
    rates = [group["lr"] for group in appearance.optimizer.param_groups]
    appearance.held = False
    appearance.update_learning_rate(10)
    assert rates == [0.0] * 4 and [g["lr"] for g in appearance.optimizer.param_groups] == pytest.approx(
        [3e-4, 1e-3, 1e-5, 2e-5]
    )


def test_a_fit_finds_the_least_squares():
    """SciPy's minimum, of each channel; pixels that do not count, and those beyond white, do not matter."""
    appearance, generator = _random(size=0.3), torch.Generator().manual_seed(1)
    image, row = torch.rand(3, 12, 16, generator=generator), appearance.camera_of(4)
    gains = torch.tensor([0.9, -0.4, 0.2])[:, None, None]
    target = (appearance._show(image, gains, row) + 0.05 * torch.randn(3, 12, 16, generator=generator)).clamp(0, 1)
    counts = torch.arange(16).expand(1, 12, 16) < 8
    fitted = appearance.fitted(image, torch.where(counts, target, 0.0), counts, 4)

    def error(gains: np.ndarray) -> float:
        seen = appearance._show(image, torch.tensor(gains, dtype=torch.float32)[:, None, None], row).clamp(0, 1)
        return (seen - target)[:, :, :8].double().square().mean().item()

    found = minimize(error, np.zeros(3), method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-12})
    least = appearance._show(image, torch.tensor(found.x, dtype=torch.float32)[:, None, None], row).clamp(0, 1)
    torch.testing.assert_close(fitted, least, rtol=0, atol=2e-3)
    assert torch.equal(PhotoAppearance().fitted(image, image, counts, 4), image)  # nothing has trained


# appearance.json


def test_the_file_comes_back(tmp_path):
    appearance = _random()
    appearance.write(tmp_path)
    again, image = read_appearance(tmp_path, VIEWS), torch.rand(3, 4, 5)
    for name in NAMES:
        torch.testing.assert_close(again.shown(image, name), appearance.shown(image, name))
    assert list(json.loads((tmp_path / NAME).read_text())["cameras"]) == ["4", "7"]
    assert PhotoAppearance(NAMES, [0, 1, 2]).rows == {"all": 0}  # frames that are numbered


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda table: None, "cannot read .*appearance.json"),
        (lambda table: [1], "is no table of appearances"),
        (lambda table: table | {"photos": {"a.png": [0, 0, 0]}}, "has no entry for b.png, so it belongs to other"),
        (lambda table: table | {"cameras": {"4": table["cameras"]["4"]}}, "has no entry for 7, so"),
        (lambda table: table | {"photos": dict.fromkeys(NAMES, [0, 1])}, "photos in .* are not .3,. finite numbers"),
        (lambda table: table | {"photos": dict.fromkeys(NAMES, "x")}, "is no table of appearances"),
        (lambda table: table | {"photos": dict.fromkeys(NAMES, [1e999] * 3)}, "photos in .* are not"),
    ],
)
def test_a_broken_file_is_named(tmp_path, change, words):
    _random().write(tmp_path)
    table = change(json.loads((tmp_path / NAME).read_text()))
    (tmp_path / NAME).unlink() if table is None else (tmp_path / NAME).write_text(json.dumps(table))
    with pytest.raises(UserError, match=f"{words}.*; save the model again, or give --appearance none"):
        read_appearance(tmp_path, VIEWS)


# Trainings


def _darkened(scene: Path, gain: float = 0.6) -> list[str]:
    """Make every third photo darker; their names."""
    images = scene / "images"
    photos = sorted(images.rglob("*.png"), key=lambda path: path.relative_to(images).as_posix())[1::3]
    for path in photos:
        Image.fromarray((np.asarray(Image.open(path)) * gain).round().astype(np.uint8)).save(path)
    return [path.relative_to(images).as_posix() for path in photos]


def test_from_photos_of_different_exposure_to_scores_of_fitted_halves(tmp_path, monkeypatch):
    scene, out = tmp_path / "scene", tmp_path / "out"
    make_colmap_scene(scene)
    dark = _darkened(scene)
    words = "-r", 32, "--eval", "--no_curve", "--iterations", 200, "--test_iterations", 200, "--densify_from_iter", 1000
    train_on(scene, out, *words, "--disable_viewer", "--appearance", "ppisp", "--checkpoint_iterations", 50)
    photos = json.loads((out / NAME).read_text())["photos"]
    stops = {name: numbers[0] for name, numbers in photos.items()}
    assert len(stops) == 14 and abs(sum(stops.values())) < 1e-4
    assert max(stops[name] for name in dark if name in stops) < min(stops[n] for n in stops if n not in dark) - 0.2
    log = json.loads((out / "train_log.json").read_text())[-1]
    assert log["test_fitted_appearance_psnr"] > log["test_psnr"] + 0.1 and log["train_psnr"] > log["test_psnr"] + 0.1

    for command, *more in ((render, "--skip_train"), (metrics,)):
        monkeypatch.setattr(sys, "argv", ["x", "-m", str(out), *more])
        command.main()
    scores = json.loads((out / "results.json").read_text())
    assert scores.keys() == {"ours_200", "ours_200_fitted_appearance"}
    fitted = scores["ours_200_fitted_appearance"]["PSNR"]
    assert fitted == pytest.approx(log["test_fitted_appearance_psnr"], abs=0.6)  # which is a mean over channels
    pairs = [[np.asarray(Image.open(out / f"test/ours_200/{side}/{n:05d}.png"))[:, 16:] for side in ("gt", "renders")]
             for n in range(3)]  # fmt: skip
    unfitted = scores["ours_200_fitted_appearance"]["PSNR_UNFITTED"]
    assert unfitted < fitted
    assert unfitted == pytest.approx(np.mean([peak_signal_noise_ratio(*pair) for pair in pairs]), abs=1e-9)
    assert log["test_right_halves_psnr"] == pytest.approx(unfitted, abs=0.6)
    run = read_run(Run(SceneEntry("x", "scenes", scene), None, None, out, (), ()), tmp_path, None)
    assert run["iterations"]["200"]["PSNR_fitted_appearance"] == fitted
    assert Image.open(out / "test/ours_200_fitted_appearance/gt/00000.png").size == (16, 21)

    (out / "model.json").write_text("{}")  # as of a training without: any model's views can be fitted
    found = load_saved(options_of(scene, out, eval=True, appearance="ppisp"), -1)
    assert not found.gaussians.exposures.mapping

    start = "--start_checkpoint", out / "chkpnt50.pth"
    for more, words_of in (((), "trained with --appearance ppisp"), (("--train_test_exp",), "--appearance ppisp")):
        with pytest.raises(UserError, match=words_of):
            train_on(scene, tmp_path / "other", "-r", 32, "--eval", *more, *start)
    with pytest.raises(UserError, match="exposures are of other photos than this run's"):
        train_on(scene, tmp_path / "other", "-r", 32, "--appearance", "ppisp", *start)


def test_affine_is_train_test_exp(colmap_scene, tmp_path):
    results = [trained(colmap_scene, tmp_path / words[-1], *words)
               for words in (["--train_test_exp"], ["--appearance", "affine"])]  # fmt: skip
    assert results[0] == results[1]
    assert (tmp_path / "affine" / "exposure.json").is_file() and not (tmp_path / "affine" / NAME).exists()


def test_one_photo_is_refused(tmp_path):
    make_colmap_scene(tmp_path / "one", views=2)
    with pytest.raises(UserError, match="needs at least two training photos"):
        train_on(tmp_path / "one", tmp_path / "out", "--eval", "--appearance", "ppisp")


def test_test_views_may_have_the_names_of_training_photos(tmp_path):
    make_blender_scene(tmp_path / "scene")
    found = Scene(options_of(tmp_path / "scene", tmp_path / "out", eval=True, appearance="ppisp"), GaussianModel(0),
                  start=False)  # fmt: skip
    found.gaussians.exposures = appearance_of(found.info.train_cameras)
    assert list(found.gaussians.exposures.mapping) == [f"r_{k}" for k in range(4)]
    seen = {name: [has_trained_exposure(view, found.gaussians) for view in views]
            for name, views in (("train", found.getTrainCameras()), ("test", found.getTestCameras()))}  # fmt: skip
    assert seen == {"train": [True] * 4, "test": [False] * 2}


def _track(points: np.ndarray, ranks: np.ndarray) -> PhotoPoints:
    """A track of points that lie at the pixel of their rank."""
    places = (np.stack([ranks % SIDE, ranks // SIDE], axis=1) + 0.5) / SIDE
    ones = np.ones(len(ranks))
    return PhotoPoints(points, np.zeros((len(ranks), 2)), places, ones, ones, ranks)


def _camera(image: np.ndarray) -> SimpleNamespace:
    pixels = torch.from_numpy(image.reshape(3, SIDE, SIDE))
    return SimpleNamespace(device="cpu", target=lambda _: pixels)


def test_exposures_are_those_of_the_photos_though_some_points_disagree():
    rng, given = np.random.default_rng(0), np.array([-0.7, 0.2, 0.4, 0.0, 0.1])
    albedo, cameras, tracks = rng.uniform(0.1, 0.4, (3, SIDE**2)), [], []
    for exposure in given:
        light = albedo * 2**exposure
        light[:, rng.choice(SIDE**2, 40, replace=False)] = 0.9  # highlights
        image = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
        cameras.append(_camera(image))
        ranks = np.sort(rng.choice(SIDE**2, 300, replace=False))
        tracks.append(_track(np.zeros((300, 3)), ranks))
    np.testing.assert_allclose(exposures(cameras, tracks), given - given.mean(), atol=0.02)
