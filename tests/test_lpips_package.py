"""The package lpipsPyTorch: values of the `lpips` package, gradients, networks that are kept, and errors."""

import importlib
import warnings
from pathlib import Path

import pytest
import torch

import lpipsPyTorch
from lpipsPyTorch import lpips
from lpipsPyTorch.modules.lpips import LPIPS
from utils import lpips_utils
from utils.lpips_utils import NETS, LpipsUnavailable, import_lpips


@pytest.fixture(scope="module")
def judges(tmp_path_factory) -> tuple[Path, dict[str, torch.nn.Module]]:
    """A cache folder of torch with stand-in weights for every backbone, and the `lpips` package's models with them."""
    package, home, made = import_lpips(), tmp_path_factory.mktemp("torch_home"), {}
    models = importlib.import_module("torchvision.models")
    (home / "hub" / "checkpoints").mkdir(parents=True)
    for net, name in NETS.items():
        torch.manual_seed(7)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torchvision's about an argument that lpips still uses
            made[net] = package.LPIPS(net=net, pnet_rand=True, verbose=False).eval()
        state = {f"features.{key.split('.', 1)[1]}": value for key, value in made[net].net.state_dict().items()}
        url = models.get_model_weights(name).IMAGENET1K_V1.url
        torch.save(state, home / "hub" / "checkpoints" / url.rsplit("/", 1)[1])
    return home, made


@pytest.fixture(autouse=True)
def cache_of_torch(judges, monkeypatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(judges[0]))
    lpipsPyTorch._network.cache_clear()


def images(count: int = 1) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return [torch.rand(count, 3, 48, 40, generator=generator) for _ in range(2)]


@pytest.mark.parametrize("net", NETS)
def test_values_are_the_packages_of_images_as_they_are(net, judges):
    x, y = images()
    distance = lpips(x, y, net_type=net)
    wanted = judges[1][net](x, y)
    assert distance.shape == (1, 1, 1, 1) and distance.item() == wanted.item() > 0
    assert distance.item() != judges[1][net](x, y, normalize=True).item()
    assert torch.equal(LPIPS(net, "0.1")(x, y), distance)


def test_the_default_is_alex_and_a_batch_is_summed():
    x, y = images(3)
    each = [lpips(a, b) for a, b in zip(x, y, strict=True)]
    assert each[0].shape == (1, 1, 1, 1) and torch.equal(each[0], lpips(x[:1], y[:1], "alex", "0.1"))
    batch = lpips(x, y)
    assert batch.shape == (1, 1, 1, 1)
    torch.testing.assert_close(batch, sum(each))
    assert lpips(x, x).item() == 0


def test_gradients_flow_to_images_and_not_to_the_network():
    x, y = images()
    with torch.inference_mode():
        lpips(x, y)  # which makes the network
    x.requires_grad_()
    lpips(x, y).mean().backward()
    assert x.grad.isfinite().all() and x.grad.any()
    assert not any(parameter.requires_grad for parameter in LPIPS().parameters())


def test_networks_are_kept(monkeypatch):
    made = []
    load = lpips_utils.load_network
    monkeypatch.setattr("lpipsPyTorch.modules.lpips.load_network", lambda *args: made.append(args[0]) or load(*args))
    x, y = images()
    for _ in range(3):
        lpips(x, y, net_type="alex")
        lpips(x, y, net_type="squeeze")
    assert made == ["alex", "squeeze"]


def test_the_module_stays_in_evaluation():
    network, (x, y) = LPIPS(), images()
    assert isinstance(network, torch.nn.Module)
    distance = network(x, y)
    assert torch.equal(network.train()(x, y), distance) and not network.training


def test_other_versions_and_nets_are_refused():
    x, y = images()
    with pytest.raises(ValueError, match=r"version 0.1 here, got '0.0'"):
        lpips(x, y, version="0.0")
    with pytest.raises(ValueError, match="one of alex, vgg, squeeze, got 'resnet'"):
        lpips(x, y, net_type="resnet")


def test_without_weights_the_error_says_where_to_put_them(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(lpips_utils, "_network_failed", True)
    for net, name in NETS.items():
        with pytest.raises(LpipsUnavailable, match=f"put .*/{name}-.* at {tmp_path}/hub/checkpoints/{name}"):
            lpips(*images(), net_type=net)
