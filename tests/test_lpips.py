"""LPIPS, DISTS and ST-LPIPS: the values of their packages, where weights come from, and errors."""

import hashlib
import importlib
import shutil
import sys
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch

import lpipsPyTorch
import metrics
from lpipsPyTorch import lpips
from lpipsPyTorch.modules.lpips import LPIPS
from utils import lpips_utils
from utils.lpips_utils import NETS, LpipsUnavailable, import_lpips, load_network
from utils.system_utils import UserError

CPU = torch.device("cpu")


class Judges(NamedTuple):
    """A home of torch, whose cache has stand-in weights by net, and the package's models with these weights.

    urls: where torchvision would have them; the names end in the first digits of their digests.
    """

    home: Path
    files: dict[str, Path]
    urls: dict[str, str]
    models: dict[str, torch.nn.Module]


@pytest.fixture(scope="module")
def judges(tmp_path_factory) -> Judges:
    package, made = import_lpips(), Judges(tmp_path_factory.mktemp("torch_home"), {}, {}, {})
    cache = made.home / "hub" / "checkpoints"
    cache.mkdir(parents=True)
    for net, name in NETS.items():
        torch.manual_seed(7)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torchvision's about an argument that lpips still uses
            made.models[net] = package.LPIPS(net=net, pnet_rand=True, verbose=False).eval().requires_grad_(False)
        state = {f"features.{key.split('.', 1)[1]}": value for key, value in made.models[net].net.state_dict().items()}
        torch.save({**state, "classifier.6.bias": torch.zeros(1000)}, cache / name)
        digest = hashlib.sha256((cache / name).read_bytes()).hexdigest()[:8]
        made.files[net] = (cache / name).rename(cache / f"{name}-{digest}.pth")
        made.urls[net] = f"https://somewhere/{made.files[net].name}"
    return made


@pytest.fixture(autouse=True)
def _cache_of_torch(judges, monkeypatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(judges.home))
    monkeypatch.setattr(lpips_utils, "_network_failed", False)
    monkeypatch.setattr(lpips_utils, "_find_url", judges.urls.__getitem__)
    lpipsPyTorch._network.cache_clear()


def images(count: int = 1) -> list[torch.Tensor]:
    """Two batches (count, 3, 48, 40) of 8-bit colours in [0, 1]."""
    generator = torch.Generator().manual_seed(0)
    return [torch.randint(0, 256, (count, 3, 48, 40), generator=generator) / 255 for _ in range(2)]


def pixels(image: torch.Tensor) -> np.ndarray:
    """The image (1, 3, H, W) as metrics.py reads it."""
    return (image[0].permute(1, 2, 0) * 255).round().byte().numpy()


@pytest.mark.slow
@pytest.mark.parametrize("net", NETS)
def test_values_are_the_packages(net, judges):
    x, y = images()
    plain, mapped = (judges.models[net](x, y, normalize=normalize).item() for normalize in (False, True))
    distance = lpips(x, y, net_type=net)
    assert distance.shape == (1, 1, 1, 1) and distance.item() == plain > 0 and plain != mapped
    assert torch.equal(LPIPS(net, "0.1")(x, y), distance)
    if net == "squeeze":  # which metrics.py does not have
        return
    for folder in (None, judges.files[net].parent):
        ours = metrics.make_metrics(net, folder, 40)
        assert ours[f"LPIPS_{net}"](*map(pixels, (x, y)), None) == mapped
        assert net != "vgg" or ours["LPIPS"](*map(pixels, (x, y)), None) == plain


def test_under_a_mask_it_is_the_mean_of_the_packages_map(judges):
    (x, y), judge = images(), judges.models["vgg"]
    mask = torch.zeros(48, 40, dtype=torch.bool)
    mask[10:40, 5:30] = True
    judge.spatial = True
    expected, everywhere = judge(torch.where(mask, x, y), y)[0, 0][mask].mean().item(), judge(x, y).mean().item()
    judge.spatial = False
    metric = metrics.make_metrics("vgg", None, 40)["LPIPS"]
    assert metric(pixels(x), pixels(y), mask.numpy()) == expected
    hidden = np.where(mask.numpy()[..., None], pixels(x), 255 - pixels(x))
    assert metric(hidden, pixels(y), mask.numpy()) == expected
    plain = metric(pixels(x), pixels(y), None)
    assert plain != expected
    assert plain == pytest.approx(everywhere, rel=0.05)  # each layer's map is stretched to the image


def test_the_default_is_alex_and_a_batch_is_summed():
    x, y = images(3)
    each = [lpips(a, b) for a, b in zip(x, y, strict=True)]
    assert each[0].shape == (1, 1, 1, 1) and torch.equal(each[0], lpips(x[:1], y[:1], "alex", "0.1"))
    torch.testing.assert_close(lpips(x, y), sum(each))
    assert lpips(x, x).item() == 0


def test_gradients_flow_to_images_and_not_to_the_network_which_is_kept_in_evaluation(monkeypatch):
    made, load = [], lpips_utils.load_network
    monkeypatch.setattr("lpipsPyTorch.modules.lpips.load_network", lambda *args: made.append(args[0]) or load(*args))
    x, y = images()
    with torch.inference_mode():
        lpips(x, y)  # which makes the network
    x.requires_grad_()
    lpips(x, y).mean().backward()
    assert x.grad.isfinite().all() and x.grad.any()
    lpips(x, y, net_type="squeeze")
    assert made == ["alex", "squeeze"]
    network = LPIPS()
    assert isinstance(network, torch.nn.Module) and not any(value.requires_grad for value in network.parameters())
    assert torch.equal(network.train()(x, y), network(x, y)) and not network.training


def test_downloaded_weights_are_kept_with_a_checked_digest(judges, tmp_path, monkeypatch):
    def download(url, to, hash_prefix):
        assert url.endswith(f"-{hash_prefix}.pth") and len(hash_prefix) == 8
        Path(to).write_bytes(judges.files["alex"].read_bytes())

    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(torch.hub, "download_url_to_file", download)
    load_network("alex", None, CPU)
    (kept,) = (tmp_path / "hub" / "checkpoints").iterdir()
    assert kept.read_bytes() == judges.files["alex"].read_bytes()


@pytest.mark.parametrize(
    ("forbidden", "attempts", "said"),
    [
        ("", 1, "the weights of {name} cannot be downloaded; check the network, or put {place}"),
        ("0", 0, "GS_DOWNLOAD=0 forbids downloading the weights of {name}; unset it, or put {place}"),
        ("told", 0, "the weights of {name} are missing, as told above"),
    ],
)
def test_without_weights_it_is_refused_after_one_attempt(tmp_path, monkeypatch, forbidden, attempts, said):
    tried = []

    def download(url, *_, **__):
        tried.append(url)
        raise OSError("no network")

    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setenv("GS_DOWNLOAD", forbidden)
    monkeypatch.setattr(torch.hub, "download_url_to_file", download)
    for net, name in NETS.items():
        place = f"https://.*/{name}-.* at {tmp_path}/hub/checkpoints/{name}-.* or into the folder of --weights"
        with pytest.raises(LpipsUnavailable, match="^" + said.format(name=name, place=place) + "$"):
            LPIPS(net)
    assert len(tried) == attempts


def test_weights_of_a_folder_are_checked(judges, tmp_path, monkeypatch):
    def refused(net: str, words: str) -> None:
        with pytest.raises(UserError, match=words):
            metrics.make_metrics(net, tmp_path, 40)

    monkeypatch.setattr(torch.hub, "download_url_to_file", lambda *_, **__: pytest.fail("a download"))
    name, url = judges.files["vgg"].name, judges.urls["vgg"]
    refused("vgg", f"^{tmp_path} has no file {name}, the weights of vgg16; give the folder .*, or download {url} into")
    shutil.copyfile(judges.files["alex"], tmp_path / judges.files["alex"].name)
    metrics.make_metrics("alex", tmp_path, 40)
    shutil.copyfile(judges.files["alex"], tmp_path / judges.files["vgg"].name)
    refused("both", f"{name} is damaged: its SHA-256 begins with")
    monkeypatch.setattr(
        lpips_utils, "_find_url", lambda net: judges.urls["alex"]
    )  # the right digest, but another network
    refused("vgg", "the file does not have the weights of vgg16; replace it by https://somewhere/alexnet")
    for wrong in ([1, 2], {}, {"features.0.weight": 1}):
        torch.save(wrong, tmp_path / "wrong-.pth")
        monkeypatch.setattr(lpips_utils, "_find_url", lambda net: "https://somewhere/wrong-.pth")
        refused("vgg", "does not have the weights")


def test_dists_is_the_packages(judges, tmp_path, monkeypatch, capsys):
    package, folder = pytest.importorskip("DISTS_pytorch"), judges.files["vgg"].parent
    x, y = images()
    models = importlib.import_module("torchvision.models")
    state = torch.load(judges.files["vgg"], weights_only=True)
    with torch.device("meta"):
        whole = models.vgg16()
    whole.load_state_dict(state, strict=False, assign=True)
    monkeypatch.setattr(models, "vgg16", lambda **_: whole)
    judge = package.DISTS(load_weights=False)
    own = torch.load(Path(package.__file__).with_name("weights.pt"), weights_only=True)
    judge.alpha.data, judge.beta.data = own["alpha"], own["beta"]
    ours = metrics.make_metrics("vgg", folder, 40)["DISTS"]
    assert ours(*map(pixels, (x, y)), None) == judge(x, y).item() > 0.01
    assert ours(*map(pixels, (x, x)), None) == pytest.approx(0, abs=1e-6)
    mask = np.zeros((48, 40), bool)
    assert ours(*map(pixels, (x, y)), mask) == pytest.approx(0, abs=1e-6)

    assert "DISTS" not in metrics.make_metrics("vgg", None, 40)
    shutil.copyfile(judges.files["alex"], tmp_path / judges.files["alex"].name)
    assert "DISTS" not in metrics.make_metrics("alex", tmp_path, 40)
    monkeypatch.setitem(sys.modules, "DISTS_pytorch", None)
    assert "DISTS" not in metrics.make_metrics("vgg", folder, 40)
    said = capsys.readouterr().out
    assert said.count("DISTS is left out: ") == 2 and f"{tmp_path} has no file {judges.files['vgg'].name}, the" in said


def test_stlpips_is_the_packages(monkeypatch):
    pytest.importorskip("stlpips_pytorch")
    judge = lpips_utils.import_stlpips().LPIPS(net="alex", variant="shift_tolerant", verbose=False)  # its own loading
    assert not hasattr(sys.modules.get("torchsummary"), "embed")  # what stood for it is gone
    x, y = images()
    ours = metrics.make_metrics("alex", None, 40, stlpips=True)["STLPIPS"]
    assert ours(*map(pixels, (x, y)), None) == judge(2 * x - 1, 2 * y - 1).item() > 0.01
    mask = np.zeros((48, 40), bool)
    mask[10:40, 5:30] = True
    judge.spatial = True
    expected = judge(2 * torch.where(torch.from_numpy(mask), x, y) - 1, 2 * y - 1)[0, 0][torch.from_numpy(mask)].mean()
    assert ours(*map(pixels, (x, y)), mask) == expected.item()
    smallest = pixels(x)[:21, :21]
    assert ours(smallest, smallest, None) == 0
    with pytest.raises(UserError, match="ST-LPIPS needs images with sides of at least 21 pixels; leave --stlpips out"):
        metrics.make_metrics("alex", None, 20, stlpips=True)
    monkeypatch.setattr(lpips_utils, "_OF_STLPIPS", "0" * 64)
    with pytest.raises(UserError, match="alex_shift_tolerant.pth is damaged: .*; install stlpips-pytorch again"):
        lpips_utils.load_stlpips(CPU)


def test_weights_have_the_addresses_of_torchvision():
    import_lpips()
    weights = importlib.import_module("torchvision.models").get_model_weights
    assert all(
        f"{lpips_utils._SITE}/{lpips_utils._FILES[net]}" == weights(name).IMAGENET1K_V1.url
        for net, name in NETS.items()
    )
