"""Subclasses of GaussianModel as written for the reference: own `__init__`, other bases, names of ours reused."""

import pytest
import torch
from gaussians import GROUPS, cloud, model, options, parameters
from torch import nn

from scene.gaussian_model import GaussianModel
from scene.gaussians.attributes import INITIAL_OPACITY
from utils.general_utils import inverse_sigmoid

EMPTY = (*GROUPS.values(), "max_radii2D", "xyz_gradient_accum", "denom")


class Of2023(GaussianModel):
    """Sets what the 2023 release's `__init__` sets, and calls no other."""

    def __init__(self, sh_degree: int) -> None:
        self.active_sh_degree, self.max_sh_degree = 0, sh_degree
        for name in EMPTY:
            setattr(self, name, torch.empty(0))
        self.optimizer, self.percent_dense, self.spatial_lr_scale = None, 0, 0
        self.setup_functions()


class Of2024(Of2023):
    """The 2024 release's sets the type of the optimiser, too."""

    def __init__(self, sh_degree: int, optimizer_type: str = "default") -> None:
        super().__init__(sh_degree)
        self.optimizer_type = optimizer_type


class Short(GaussianModel):
    """Sets nothing but its activations."""

    def __init__(self, sh_degree: int) -> None:
        self.setup_functions()


class Network(nn.Module, GaussianModel):
    """A module, which takes tensors in place of parameters only before there are parameters."""

    def __init__(self, sh_degree: int) -> None:
        nn.Module.__init__(self)
        GaussianModel.__init__(self, sh_degree)
        for name in EMPTY:
            setattr(self, name, torch.empty(0))


class Reusing(GaussianModel):
    """Methods of its own by names that the reference's model does not have."""

    def raw(self) -> str:
        return "not an attribute"

    def rows(self) -> int:
        return 7

    def step(self) -> None:
        raise AssertionError("not an optimiser's step")


@pytest.mark.parametrize("kind", [Of2023, Of2024, Short, Network, Reusing])
def test_a_subclass_goes_through_everything(kind, tmp_path):
    gaussians = kind(3)
    gaussians.create_from_pcd(cloud(20), 1.5)
    gaussians.training_setup(options())
    for field in GROUPS.values():
        getattr(gaussians, field).grad = torch.ones_like(getattr(gaussians, field))
    gaussians.optimizer.step()
    gaussians.xyz_gradient_accum, gaussians.denom = torch.ones(20, 1), torch.ones(20, 1)
    gaussians.densify_and_prune(0.5, 0.005, 20.0, 20)
    gaussians.check_finite(1)
    gaussians.save_ply(tmp_path / "a.ply")
    loaded, restored = kind(3), kind(3)
    loaded.load_ply(tmp_path / "a.ply")
    restored.restore(gaussians.capture(), options())
    for again in (loaded, restored, gaussians.part(slice(None), 3)):
        assert all(torch.equal(values, parameters(gaussians)[name]) for name, values in parameters(again).items())
    assert restored.spatial_lr_scale == 1.5 and len(gaussians) > 20


def test_an_empty_model_has_plain_tensors_and_is_true():
    gaussians = GaussianModel(3)
    assert not any(isinstance(getattr(gaussians, field), nn.Parameter) for field in GROUPS.values())
    assert len(gaussians) == len(gaussians.denom) == 0 and bool(gaussians)


# Activations


def test_start_and_reset_go_through_the_inverse_activation():
    def inverse(x: torch.Tensor) -> torch.Tensor:
        return inverse_sigmoid(x) - 1

    class Client(GaussianModel):
        def setup_functions(self) -> None:
            super().setup_functions()
            self.inverse_opacity_activation = inverse

    gaussians = Client(1)
    gaussians.create_from_pcd(cloud(5), 1.0)
    assert torch.equal(gaussians._opacity.detach(), inverse(torch.full((5, 1), INITIAL_OPACITY)))
    gaussians.training_setup(options())
    gaussians.reset_opacity()
    torch.testing.assert_close(gaussians._opacity.detach(), inverse(torch.full((5, 1), 0.01)))


# Masks


@pytest.mark.parametrize(
    "mask", [torch.ones(9, dtype=torch.bool), torch.ones(10, 1, dtype=torch.bool), torch.tensor([1, 2]), torch.ones(10)]
)
def test_only_a_mask_prunes(mask):
    gaussians = model(10)
    before = gaussians._xyz
    with pytest.raises(IndexError, match=r"mask of shape \(10,\) and type bool.*this one has the shape \("):
        gaussians.prune_points(mask)
    assert gaussians._xyz is before and len(gaussians.denom) == 10
