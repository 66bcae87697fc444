"""GaussianModel: start from clouds, activations, schedules, capture and restore."""

import copy

import numpy as np
import pytest
import torch
from gaussians import FURTHER, GROUPS, cloud, model, moments, options, parameters, take_steps
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from scene.gaussian_model import GaussianModel
from utils.general_utils import get_expon_lr_func
from utils.graphics_utils import BasicPointCloud
from utils.system_utils import UserError


def _started(points: np.ndarray, extent: float = 2.0, degree: int = 3) -> GaussianModel:
    gaussians = GaussianModel(degree)
    colors = np.full_like(points, 0.25)
    gaussians.create_from_pcd(BasicPointCloud(points, colors, np.zeros_like(points)), [], extent)
    return gaussians


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_start_from_a_cloud(degree):
    points = cloud(200).points
    points[1] = points[0]
    gaussians = _started(points, degree=degree)
    distances, _ = KDTree(points.astype(np.float64)).query(points, 4)
    expected = np.sqrt(np.maximum((distances[:, 1:] ** 2).mean(1), 1e-7))
    np.testing.assert_allclose(gaussians.get_scaling.detach().numpy(), np.repeat(expected[:, None], 3, 1), rtol=1e-5)
    np.testing.assert_allclose(gaussians.get_opacity.detach().numpy(), 0.1, rtol=1e-6)
    assert gaussians._features_dc.shape == (200, 1, 3)
    np.testing.assert_allclose(gaussians._features_dc.detach().numpy(), (0.25 - 0.5) / 0.28209479177387814, rtol=1e-6)
    assert gaussians._features_rest.shape == (200, (degree + 1) ** 2 - 1, 3) and not gaussians._features_rest.any()
    assert gaussians._rotation.tolist() == [[1, 0, 0, 0]] * 200
    assert gaussians.get_features.shape == (200, (degree + 1) ** 2, 3)
    assert gaussians.active_sh_degree == 0


@pytest.mark.parametrize("points", [*(cloud(count).points for count in (1, 2, 3)), np.ones((5, 3), np.float32)])
def test_few_places_take_their_size_from_the_extent(points):
    np.testing.assert_allclose(_started(points, 2.0).get_scaling.detach().numpy(), 0.02, rtol=1e-6)


def test_an_empty_or_broken_cloud_is_refused():
    with pytest.raises(UserError, match="no points"):
        _started(np.zeros((0, 3), np.float32))
    with pytest.raises(UserError, match="not finite"):
        _started(np.array([[0, 0, np.nan]] * 5, np.float32))


def test_covariance_against_scipy():
    gaussians = model(10)
    w, x, y, z = gaussians._rotation.detach().double().numpy().T
    scales = 1.5 * gaussians.get_scaling.detach().double().numpy()
    axes = Rotation.from_quat(np.stack((x, y, z, w), 1)).as_matrix() * scales[:, None]
    full = axes @ axes.transpose(0, 2, 1)
    expected = full[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    np.testing.assert_allclose(gaussians.get_covariance(1.5).detach().numpy(), expected, atol=1e-6 * np.abs(full).max())
    np.testing.assert_allclose(gaussians.get_rotation.detach().norm(dim=1).numpy(), 1, rtol=1e-6)


def test_position_learning_rate():
    gaussians, rate = model(4, extent=3.0), get_expon_lr_func(1.6e-4, 1.6e-6, max_steps=30_000)
    for iteration in (0, 15_000, 40_000):
        assert gaussians.update_learning_rate(iteration) == pytest.approx(3.0 * rate(iteration), rel=1e-12)
        assert gaussians.optimizer.param_groups[0]["lr"] == gaussians.position_learning_rate


def test_capture_and_restore():
    gaussians = model(30, extent=1.5, active=False)
    gaussians.oneupSHdegree()
    take_steps(gaussians, 3)
    gaussians.max_radii2D += 3
    gaussians.denom += 2
    gaussians.xyz_gradient_accum += 0.5
    capture = gaussians.capture()
    assert len(capture) == 12 + len(FURTHER)
    other = GaussianModel(3)
    other.restore(capture, options(feature_lr=0.5))
    for name, value in parameters(gaussians).items():
        assert torch.equal(parameters(other)[name], value)
        for key, moment in moments(gaussians)[name].items():
            assert torch.equal(moments(other)[name][key], moment)
    assert other.active_sh_degree == 1 and other.spatial_lr_scale == 1.5
    for name in ("max_radii2D", "denom", "xyz_gradient_accum"):
        assert torch.equal(getattr(other, name), getattr(gaussians, name))
    # Learning rates come from the command line, not from the checkpoint.
    assert [group["lr"] for group in other.optimizer.param_groups][1:3] == [0.5, 0.025]


def test_restore_refuses_other_attributes():
    capture = model(5).capture()
    with pytest.raises(UserError, match=rf"has {len(GROUPS) + 1} attributes per Gaussian.*has {len(GROUPS)} \(xyz"):
        GaussianModel(3).restore((*capture, torch.zeros(5, 1)), options())


def test_a_copy_has_statistics_of_its_own():
    gaussians = model(50)
    other = copy.copy(gaussians)
    other.max_radii2D = torch.ones(50)
    other.denom = torch.ones(3, 1)
    assert gaussians.max_radii2D.sum() == 0 and gaussians.denom.shape == (50, 1)


def test_a_model_that_loads_a_ply_keeps_its_optimiser(tmp_path):
    gaussians = model(5)
    optimiser = gaussians.optimizer = object()
    gaussians.save_ply(tmp_path / "a.ply")
    gaussians.load_ply(tmp_path / "a.ply")
    assert gaussians.optimizer is optimiser and gaussians.part(slice(2), 1).optimizer is None
