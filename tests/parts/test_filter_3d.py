"""The 3D smoothing filter (--filter_3d): its formulas, and what a training with it leaves."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from gaussians import pipeline
from scipy.spatial.transform import Rotation
from synthetic import FOCAL, make_colmap_scene, options_of
from trainings import ITERATIONS, OPTIONS, plain_training, shared_scene, trained, whole_result

from gaussian_renderer import render
from scene import GaussianModel, Scene
from scene.gaussians.checkpoint import extra_state, load_checkpoint, save_checkpoint, with_extra_state
from scene.gaussians.filtered import filtered
from splatting.parts.filter_3d import filter_widths
from utils.system_utils import UserError

ON = "--filter_3d", "--antialiasing"


def _raw(count: int = 200) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Logits, log scales and widths of Gaussians, also opaque, flat and unfiltered ones."""
    generator = torch.Generator().manual_seed(0)
    logits, log_scales, widths = (torch.randn(count, n, generator=generator) for n in (1, 3, 1))
    widths = (widths - 3).exp()
    widths[:9] = 0
    return 5 * logits, 2 * log_scales - 3, widths


def test_covariances_and_opacities_are_those_of_the_paper():
    logits, log_scales, widths = _raw()
    found_logits, found_scales = (x.double().numpy() for x in filtered(logits, log_scales, widths))
    turns = Rotation.random(len(logits), random_state=0).as_matrix()
    scales, f = log_scales.double().exp().numpy(), widths.double().numpy()
    before = turns @ (scales[:, :, None] ** 2 * turns.transpose(0, 2, 1))
    after = before + f[:, :, None] ** 2 * np.eye(3)
    covariances = turns @ (np.exp(2 * found_scales)[:, :, None] * turns.transpose(0, 2, 1))
    largest = np.abs(after).max((1, 2), keepdims=True)
    np.testing.assert_allclose(covariances / largest, after / largest, atol=2e-6)
    opacity = np.sqrt(np.linalg.det(before) / np.linalg.det(after)) / (1 + np.exp(-logits.double().numpy()[:, 0]))
    np.testing.assert_allclose(1 / (1 + np.exp(-found_logits[:, 0])), opacity, rtol=3e-5)
    off = f[:, 0] == 0
    torch.testing.assert_close(torch.from_numpy(found_logits[off]).float(), logits[:9], rtol=1e-6, atol=1e-6)
    assert (found_scales[off] == log_scales[:9].numpy()).all()
    extreme = filtered(torch.tensor([[math.inf], [-math.inf], [90.0]]), torch.zeros(3, 3), torch.ones(3, 1))
    assert torch.isfinite(extreme[1]).all() and not torch.isnan(extreme[0]).any()


def test_gradients_are_those_by_differences():
    raw = [x[:20].double() for x in _raw()]
    for x in raw[:2]:
        x.requires_grad_()
    assert torch.autograd.gradcheck(lambda *of: filtered(*of, raw[2]), raw[:2], eps=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("model", "distortion"), [("PINHOLE", ()), ("OPENCV", (-0.1, 0.01, 0.0, 0.0)), ("OPENCV_FISHEYE", (0.01, 0, 0, 0))]
)
def test_widths_follow_from_the_nearest_view_that_shows_a_point(tmp_path, model, distortion):
    known = make_colmap_scene(tmp_path / "scene", model=model, params=(FOCAL, FOCAL, 48.0, 32.0, *distortion), views=6)
    scene = Scene(options_of(tmp_path / "scene", tmp_path / "out", lenses="native"), GaussianModel(0), shuffle=False)
    points = np.random.default_rng(0).uniform(-2, 2, (300, 3))
    rates = np.zeros(300)
    for image in known.images.values():
        seen = np.array([image.cam_from_world() * point for point in points])
        across, down = FOCAL * seen[:, :2].T / seen[:, 2]
        shown = (np.abs(across) < 48) & (np.abs(down) < 32) & (seen[:, 2] > 0.2)
        depth = seen[:, 2]
        if "FISHEYE" in model:
            depth = np.linalg.norm(seen, axis=1)
            field = scene.getTrainCameras()[0].lens.field(96, 64)
            shown = np.arccos(seen[:, 2] / depth) < field
        rates = np.maximum(rates, np.where(shown, FOCAL / depth, 0))
    found = filter_widths(torch.from_numpy(points).float(), scene.getTrainCameras())
    expected = np.divide(math.sqrt(0.05), rates, out=np.zeros(300), where=rates > 0)
    assert (expected > 0).any() and expected.min() < expected.max()
    np.testing.assert_allclose(found[:, 0].numpy(), expected, rtol=1e-4)


@pytest.fixture(scope="module")
def scene(_colmap_master: Path) -> Path:
    return _colmap_master


def test_a_training_with_it_is_another_and_a_damaged_one_is_refused(once, tmp_path):
    name, start = "filter and budget", tmp_path / "chkpnt33.pth"
    scene, whole = shared_scene(once), plain_training(once, name)
    off = trained(scene, tmp_path / "off", *OPTIONS[name][1:])
    assert off["ply"] != whole_result(whole, ITERATIONS)["ply"]
    capture, iteration = load_checkpoint(whole / "chkpnt33.pth")
    save_checkpoint(
        start, with_extra_state(capture, {"filter_3d": extra_state(capture).get("filter_3d")[1:]}), iteration
    )
    with pytest.raises(UserError, match="the 3D filter of the checkpoint does not fit"):
        trained(scene, tmp_path / "wrong", *OPTIONS[name], "--start_checkpoint", start)


def test_the_ply_looks_as_the_model_and_needs_no_filter(scene, tmp_path, monkeypatch):
    view = Scene(options_of(scene, tmp_path / "other"), GaussianModel(3)).getTrainCameras()[0]
    pipe, black, save, images = pipeline(antialiasing=True), torch.zeros(3), GaussianModel.save_ply, []

    def saved(self, path):
        images.append(render(view, self, pipe, black)["render"].detach())
        by_getters = render(view, self, pipeline(antialiasing=True, compute_cov3D_python=True), black)["render"]
        torch.testing.assert_close(by_getters, images[0], rtol=1e-3, atol=1e-3)
        assert (self.columns["filter_3d"] > 0).any()
        save(self, path)
        read = GaussianModel(3)
        read.load_ply(path)
        read.active_sh_degree = self.active_sh_degree
        images.append(render(view, read, pipe, black)["render"].detach())
        assert read.drawn is None and (read.get_opacity < torch.sigmoid(self.raw("opacity"))).any()

    monkeypatch.setattr(GaussianModel, "save_ply", saved)
    trained(scene, tmp_path / "out", *ON, "--keep_unseen")
    assert torch.equal(*images)
