"""metrics.py: numbers against independent code, files by contract, LPIPS against its package, errors."""

import json
import math
import socket
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

import metrics
from splatting.files import image_files
from utils import lpips_utils
from utils.lpips_utils import LpipsUnavailable, PerceptualDistance, import_lpips
from utils.system_utils import UserError, compute_device, run_cli

ROOT = Path(__file__).parents[1]


def picture(seed: int, height: int = 40, width: int = 56) -> np.ndarray:
    """A smooth random image (H, W, 3) uint8."""
    rng = np.random.default_rng(seed)
    small = Image.fromarray(rng.integers(0, 256, (7, 9, 3), dtype=np.uint8))
    return np.asarray(small.resize((width, height), Image.Resampling.BICUBIC))


def noisy(image: np.ndarray, seed: int, sigma: float = 12) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(scale=sigma, size=image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def make_model(folder: Path, names: tuple[str, ...] = ("00001.png", "00000.png"), method: str = "ours_30") -> Path:
    """A model folder with test renders, ground truth and cfg_args."""
    for side in ("renders", "gt"):
        (folder / "test" / method / side).mkdir(parents=True)
    for seed, name in enumerate(names):
        truth = picture(seed)
        Image.fromarray(truth).save(folder / "test" / method / "gt" / name)
        Image.fromarray(noisy(truth, seed)).save(folder / "test" / method / "renders" / name)
    (folder / "cfg_args").write_text("Namespace(sh_degree=3, eval=True)")
    return folder


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Run metrics.py without cached weights and network; return (status, stdout, stderr)."""

    def command(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["metrics.py", *map(str, arguments)])
        monkeypatch.setenv("TORCH_HOME", str(tmp_path / "cache"))
        monkeypatch.setenv("https_proxy", "http://127.0.0.1:9")
        monkeypatch.setattr(lpips_utils, "_network_failed", False)
        status = 0
        try:
            run_cli(metrics.main)
        except SystemExit as stop:
            status = stop.code
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return command


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> dict[str, tuple[Path, torch.nn.Module]]:
    """For each backbone, a state-dict file in torchvision's format and the package's model with the same weights."""
    lpips = import_lpips()
    made = {}
    for net in ("vgg", "alex"):
        torch.manual_seed(7)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torchvision's about an argument that lpips still uses
            judge = lpips.LPIPS(net=net, pnet_rand=True, verbose=False).eval()
        state = {f"features.{name.split('.', 1)[1]}": value for name, value in judge.net.state_dict().items()}
        file = tmp_path_factory.mktemp("weights") / f"{net}.pth"
        torch.save({**state, "classifier.6.bias": torch.zeros(1000)}, file)
        made[net] = file, judge
    return made


def test_psnr_is_scikit_images():
    truth = picture(1)
    render = noisy(truth, 2)
    assert metrics.psnr(render, truth) == pytest.approx(peak_signal_noise_ratio(truth, render), abs=1e-9)


def test_psnr_comes_from_one_error_over_channels():
    truth = np.zeros((4, 4, 3), np.uint8)
    render = truth.copy()
    render[..., 0] = 51  # 0.2 in one channel of three: mean squared error 0.04 / 3
    assert metrics.psnr(render, truth) == pytest.approx(-10 * math.log10(0.04 / 3), abs=1e-9)


def test_psnr_of_equal_images_is_no_number():
    assert metrics.psnr(picture(1), picture(1)) is None


def test_ssim_is_scikit_images_inside_and_zero_padded_at_the_border():
    truth = picture(3)
    render = noisy(truth, 4)
    options = {
        "data_range": 1.0,
        "channel_axis": 2,
        "gaussian_weights": True,
        "sigma": 1.5,
        "use_sample_covariance": False,
        "full": True,
    }
    # scikit-image reflects at borders. With black rims of the window's radius, both see zeros there.
    padded = [np.pad(image, ((5, 5), (5, 5), (0, 0))) / 255.0 for image in (render, truth)]
    _, full = structural_similarity(*padded, **options)
    assert metrics.ssim(render, truth) == pytest.approx(full[5:-5, 5:-5].mean(), abs=1e-9)


def test_ssim_of_a_picture_smaller_than_the_window():
    assert metrics.ssim(picture(1, 5, 7), picture(1, 5, 7)) == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("net", ["vgg", "alex"])
def test_lpips_is_the_packages(weights, net):
    file, judge = weights[net]
    others = [path for path, _ in weights.values()]
    truth = picture(5, 48, 64)
    images = [torch.from_numpy(image.transpose(2, 0, 1).copy())[None] / 255 for image in (noisy(truth, 6), truth)]
    for paths in ([file], others):  # several files: the one that fits is found
        distance = PerceptualDistance(net, paths, torch.device("cpu"))
        for unit_range in (True, False):
            with torch.no_grad():
                expected = judge(*images, normalize=not unit_range).item()
            assert distance(images[0][0], images[1][0], unit_range=unit_range) == expected


def test_lpips_under_a_mask_is_the_mean_of_the_packages_map(weights):
    file, judge = weights["alex"]
    truth = picture(5, 48, 64)
    images = [torch.from_numpy(image.transpose(2, 0, 1).copy()) / 255 for image in (noisy(truth, 6), truth)]
    mask = torch.zeros(48, 64, dtype=torch.bool)
    mask[10:40, 5:30] = True
    distance = PerceptualDistance("alex", [file], torch.device("cpu"))
    judge.spatial = True
    with torch.no_grad():
        expected = judge(images[0][None], images[1][None])[0, 0][mask].mean().item()
        everywhere = judge(images[0][None], images[1][None]).mean().item()
    judge.spatial = False
    assert distance(*images, unit_range=True, mask=mask) == expected
    plain = distance(*images, unit_range=True)
    assert plain != expected and plain == pytest.approx(
        everywhere, rel=0.05
    )  # each layer's map is stretched to the image

    metric = metrics._lpips_metric(distance, True, torch.device("cpu"))
    shown, mask = noisy(truth, 6), mask.numpy()
    hidden = np.where(mask[..., None], shown, 255 - shown)
    assert metric(hidden, truth, mask) == metric(shown, truth, mask) < metric(shown, truth)


def test_lpips_takes_the_cached_weights(weights, tmp_path, monkeypatch):
    file, judge = weights["alex"]
    (tmp_path / "hub" / "checkpoints").mkdir(parents=True)
    (tmp_path / "hub" / "checkpoints" / "alexnet-owt-7be5be79.pth").symlink_to(file)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    distance = PerceptualDistance("alex", [], torch.device("cpu"))
    images = torch.rand(2, 3, 40, 40, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        assert distance(*images, unit_range=True) == judge(images[:1], images[1:]).item()


def test_downloaded_weights_are_kept_with_a_checked_digest(weights, tmp_path, monkeypatch):
    file, _ = weights["alex"]

    def download(url, to, hash_prefix):
        assert url.endswith(f"-{hash_prefix}.pth") and len(hash_prefix) == 8
        Path(to).write_bytes(file.read_bytes())

    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(torch.hub, "download_url_to_file", download)
    monkeypatch.setattr(lpips_utils, "_network_failed", False)
    PerceptualDistance("alex", [], torch.device("cpu"))
    (kept,) = (tmp_path / "hub" / "checkpoints").iterdir()
    assert kept.read_bytes() == file.read_bytes()


def test_lpips_without_weights_is_refused_after_one_attempt(tmp_path, monkeypatch):
    attempts = []

    def refuse(url, *_, **__):
        attempts.append(url)
        raise OSError("no network")

    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(torch.hub, "download_url_to_file", refuse)
    monkeypatch.setattr(lpips_utils, "_network_failed", False)
    for net, name in (("vgg", "vgg16"), ("alex", "alexnet")):
        with pytest.raises(LpipsUnavailable, match=f"put .*{name}.* at {tmp_path}/hub/checkpoints/{name}"):
            PerceptualDistance(net, [], torch.device("cpu"))
    assert len(attempts) == 1


def test_a_network_that_never_answers_is_given_up(tmp_path, monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as silent:
        monkeypatch.setenv("TORCH_HOME", str(tmp_path))
        monkeypatch.setenv("https_proxy", f"http://127.0.0.1:{silent.getsockname()[1]}")
        monkeypatch.setattr(lpips_utils, "_network_failed", False)
        monkeypatch.setattr(lpips_utils, "_DOWNLOAD_TIMEOUT", 0.3)
        with pytest.raises(LpipsUnavailable):
            PerceptualDistance("alex", [], torch.device("cpu"))
    assert socket.getdefaulttimeout() is None


def test_lpips_weights_of_the_wrong_kind(weights, tmp_path):
    def refused(content: object, net: str = "vgg") -> str:
        file = tmp_path / "weights.pth"
        torch.save(content, file)
        with pytest.raises((UserError, LpipsUnavailable)) as caught:
            PerceptualDistance(net, [file], torch.device("cpu"))
        return str(caught.value)

    vgg = torch.load(weights["vgg"][0], weights_only=True)
    assert "torchvision's vgg16 or alexnet" in refused({"something": torch.zeros(3)})
    assert "features.28.weight" in refused({name: value for name, value in vgg.items() if "28.weight" not in name})
    assert "list" in refused([1, 2])
    assert "which are never run" in refused({"features.0.weight": bytearray(9)})
    assert "alexnet" in refused(vgg, "alex")
    (tmp_path / "garbage.pth").write_bytes(b"no weights at all")
    for file in ("garbage.pth", "missing.pth"):
        with pytest.raises(UserError, match=file):
            PerceptualDistance("vgg", [tmp_path / file], torch.device("cpu"))


def test_files_by_contract(tmp_path, weights, run):
    model = make_model(tmp_path / "model")
    files = [path for path, _ in weights.values()]
    status, out, _ = run("-m", model, "--lpips_net", "both", "--lpips_weights", *files)
    assert status == 0 and "warning" not in out
    text = (model / "results.json").read_text()
    results, per_view = json.loads(text), json.loads((model / "per_view.json").read_text())
    keys = ["SSIM", "PSNR", "LPIPS", "LPIPS_vgg", "LPIPS_alex"]
    assert list(results) == list(per_view) == ["ours_30"]
    assert list(results["ours_30"]) == list(per_view["ours_30"]) == keys
    assert text.startswith('{\n "ours_30": {\n  "SSIM": ')
    for key in keys:
        values = per_view["ours_30"][key]
        assert list(values) == ["00000.png", "00001.png"]
        assert results["ours_30"][key] == pytest.approx(sum(values.values()) / 2)
    info = json.loads((model / "metrics_info.json").read_text())
    assert set(info["conventions"]) == set(keys)
    assert info["views"] == {"ours_30": 2}
    assert info["trained_with_eval"] is True

    # LPIPS takes unmapped inputs, the others map them to [-1, 1]; the package itself computes both.
    pair = [Image.open(model / "test" / "ours_30" / side / "00000.png") for side in ("renders", "gt")]
    images = [torch.from_numpy(np.asarray(image).transpose(2, 0, 1).copy())[None] / 255 for image in pair]
    for key, net, normalize in (("LPIPS", "vgg", False), ("LPIPS_vgg", "vgg", True), ("LPIPS_alex", "alex", True)):
        with torch.no_grad():
            expected = weights[net][1](*images, normalize=normalize).item()
        assert per_view["ours_30"][key]["00000.png"] == expected


def test_images_of_two_folders_as_tensors(tmp_path):
    folder = make_model(tmp_path / "model") / "test" / "ours_30"
    Image.fromarray(picture(9)).convert("RGBA").save(folder / "gt" / "00001.png")
    renders, truths, names = metrics.readImages(folder / "renders", folder / "gt")
    assert names == ["00000.png", "00001.png"]
    for side, images in (("renders", renders), ("gt", truths)):
        for name, image in zip(names, images, strict=True):
            assert image.shape == (1, 3, 40, 56) and image.dtype == torch.float32 and image.is_contiguous()
            assert image.device.type == compute_device().type
            with Image.open(folder / side / name) as file:
                pixels = np.asarray(file.convert("RGB"), dtype=np.float32)
            np.testing.assert_array_equal(image[0].cpu().numpy().transpose(1, 2, 0), pixels / 255)
    by_text = metrics.readImages(str(folder / "renders"), str(folder / "gt"))
    assert torch.equal(by_text[0][1], renders[1])


def test_scores_of_folders_by_a_call_are_the_commands(tmp_path, run, monkeypatch, capsys):
    first, second = make_model(tmp_path / "a"), make_model(tmp_path / "b")
    assert run("-m", first)[0] == 0
    monkeypatch.setattr(lpips_utils, "_network_failed", True)
    assert metrics.evaluate([str(second)]) is None
    for name in ("results.json", "per_view.json", "metrics_info.json"):
        assert (second / name).read_bytes() == (first / name).read_bytes()
    assert f"{second} ours_30 (2 views): SSIM" in capsys.readouterr().out
    with pytest.raises(UserError, match="no such model folder"):
        metrics.evaluate([tmp_path / "nowhere"])


def test_without_weights_lpips_is_null_and_says_what_to_do(tmp_path, run):
    model = make_model(tmp_path / "model")
    (model / "cfg_args").write_text("Namespace(sh_degree=3, eval=False)")
    status, out, _ = run("-m", model)
    assert status == 0
    lines = [line for line in out.splitlines() if "LPIPS, LPIPS_vgg are null unless scored before: its weights" in line]
    assert len(lines) == 1 and str(tmp_path / "cache" / "hub" / "checkpoints") in lines[0]
    assert "warning" in out and "without --eval" in out
    scores = json.loads((model / "results.json").read_text())["ours_30"]
    assert scores["LPIPS"] is None and scores["LPIPS_vgg"] is None and scores["PSNR"] > 20
    per_view = json.loads((model / "per_view.json").read_text())["ours_30"]
    assert per_view["LPIPS"] == {"00000.png": None, "00001.png": None}


def test_lpips_scored_before_is_kept_where_it_cannot_be_scored_again(tmp_path, weights, run):
    model = make_model(tmp_path / "model")
    files = [path for path, _ in weights.values()]
    run("-m", model, "--lpips_net", "both", "--lpips_weights", *files)
    names = ("results.json", "per_view.json", "metrics_info.json")
    before = [json.loads((model / name).read_text()) for name in names]
    status, out, err = run("-m", model)
    assert status == 0 and "Traceback" not in err
    assert "kept LPIPS, LPIPS_vgg, LPIPS_alex of an earlier scoring of the same pictures" in out
    assert [json.loads((model / name).read_text()) for name in names] == before

    Image.fromarray(picture(5)).save(model / "test" / "ours_30" / "renders" / "00001.png")  # another render
    status, out, _ = run("-m", model)
    assert status == 0 and "kept" not in out
    scores = json.loads((model / "results.json").read_text())["ours_30"]
    assert scores["LPIPS"] is None and "LPIPS_alex" not in scores and scores["PSNR"] > 0


@pytest.mark.parametrize("content", ["{", "[]", '{"ours_30": {"PSNR": {}}}', '{"ours_30": {"LPIPS": {"a": 1.0}}}'])
def test_earlier_scores_that_nobody_can_use_do_not_matter(tmp_path, run, content):
    model = make_model(tmp_path / "model")
    (model / "per_view.json").write_text(content)
    status, out, _ = run("-m", model)
    assert status == 0 and "kept" not in out


def test_without_the_package_lpips_one_line_says_so(tmp_path, run, monkeypatch):
    def missing():
        raise ModuleNotFoundError("No module named 'lpips'")

    monkeypatch.setattr(lpips_utils, "import_lpips", missing)
    status, out, err = run("-m", make_model(tmp_path / "model"), "--lpips_net", "both")
    assert status == 0 and "Traceback" not in err
    lines = [line for line in out.splitlines() if "No module named 'lpips'; run pip install" in line]
    assert len(lines) == 2  # one for each network


def test_no_download_is_tried_where_the_environment_forbids_it(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setenv("GS_DOWNLOAD", "0")
    monkeypatch.setattr(torch.hub, "download_url_to_file", lambda *_, **__: pytest.fail("it was tried"))
    monkeypatch.setattr(lpips_utils, "_network_failed", False)
    with pytest.raises(LpipsUnavailable, match="its weights are missing; put "):
        PerceptualDistance("vgg", [], torch.device("cpu"))


def test_help_says_what_happens_without_an_option(run):
    status, out, _ = run("-h")
    text = " ".join(out.split())
    assert status == 0 and "(default: none, must be given)" in text
    assert "(default: torch's cache, or else a download into it)" in text


def test_several_models_and_methods_and_alpha(tmp_path, run):
    first, second = make_model(tmp_path / "a"), make_model(tmp_path / "b", method="ours_7")
    make_model(tmp_path / "c", method="another")
    (tmp_path / "c" / "test" / "another").rename(second / "test" / "another")
    truth = second / "test" / "ours_7" / "gt" / "00000.png"
    with Image.open(truth) as image:
        opaque = image.convert("RGBA")
    opaque.putalpha(40)  # the first three channels count, whatever the alpha
    opaque.save(truth)
    assert run("-m", first, second)[0] == 0
    one = json.loads((first / "results.json").read_text())
    two = json.loads((second / "results.json").read_text())
    assert list(two) == ["another", "ours_7"]
    assert one["ours_30"] == two["ours_7"] == two["another"]


def drop_render(model: Path) -> None:
    (model / "test" / "ours_30" / "renders" / "00001.png").unlink()


def shrink_render(model: Path) -> None:
    Image.fromarray(picture(0, 20, 20)).save(model / "test" / "ours_30" / "renders" / "00001.png")


def empty_folders(model: Path) -> None:
    for file in model.glob("test/*/*/*.png"):
        file.unlink()


def truncate_render(model: Path) -> None:
    file = model / "test" / "ours_30" / "renders" / "00001.png"
    file.write_bytes(file.read_bytes()[:-200])


def drop_side(model: Path) -> None:
    empty_folders(model)
    (model / "test" / "ours_30" / "renders").rmdir()


def drop_test(model: Path) -> None:
    (model / "test").rename(model / "train")


def without_eval(model: Path) -> None:
    drop_test(model)
    (model / "cfg_args").write_text("Namespace(eval=False)")


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (drop_render, "00001.png is in gt but not in renders"),
        (shrink_render, r"00001.png has \(20, 20\) pixels"),
        (empty_folders, "no images"),
        (drop_side, "renders is missing"),
        (drop_test, "no rendered test views .*render.py"),
        (without_eval, "no rendered test views .*without --eval"),
    ],
)
def test_what_cannot_be_scored_is_said_before_anything_is(tmp_path, damage, words):
    model = make_model(tmp_path / "model")
    damage(model)
    with pytest.raises(UserError, match=words):
        metrics.find_pairs(model)


def test_a_damaged_image_ends_with_a_sentence_and_status_2(tmp_path, run):
    model = make_model(tmp_path / "model")
    truncate_render(model)
    status, _, err = run("-m", model)
    assert status == 2
    assert "00001.png is damaged" in err.splitlines()[-1]
    assert not (model / "results.json").exists()


def test_a_missing_model_ends_with_a_sentence_and_status_2(tmp_path):
    command = [sys.executable, "metrics.py", "-m", str(tmp_path / "nowhere")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"error: no such model folder: {tmp_path / 'nowhere'}\n"


def test_images_beyond_pillows_limit_are_scored_and_absurd_ones_refused(run, tmp_path, monkeypatch):
    model = make_model(tmp_path / "model")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 56 * 40 // 3)
    status, _, err = run("-m", model, "--lpips_net", "alex")
    assert status == 0, err
    assert Image.MAX_IMAGE_PIXELS == 56 * 40 // 3
    monkeypatch.setattr(image_files, "MOST_PIXELS", 56 * 40 - 1)
    status, _, err = run("-m", model)
    assert status == 2 and "00000.png is not a readable image" in err
