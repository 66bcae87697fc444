"""metrics.py: numbers against independent code, files by contract, errors. LPIPS itself: test_lpips.py."""

import hashlib
import json
import math
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

import metrics
from splatting.records.renders import GAIN, INCOMPLETE
from utils.system_utils import UserError, compute_device, run_cli

FILES = ("results.json", "per_view.json", "metrics_info.json")
SECOND = "test/ours_30/renders/00001.png"


def picture(seed: int, height: int = 40, width: int = 56) -> np.ndarray:
    """A smooth random image (H, W, 3) uint8."""
    rng = np.random.default_rng(seed)
    small = Image.fromarray(rng.integers(0, 256, (7, 9, 3), dtype=np.uint8))
    return np.asarray(small.resize((width, height), Image.Resampling.BICUBIC))


def noisy(image: np.ndarray, seed: int, sigma: float = 12) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(scale=sigma, size=image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def make_model(folder: Path, method: str = "ours_30", stored: str = "eval=True") -> Path:
    """A model folder with test renders, ground truth and cfg_args."""
    for seed, name in enumerate(("00001.png", "00000.png")):
        truth = picture(seed)
        for side, image in (("gt", truth), ("renders", noisy(truth, seed))):
            (folder / "test" / method / side).mkdir(parents=True, exist_ok=True)
            Image.fromarray(image).save(folder / "test" / method / side / name)
    (folder / "cfg_args").write_text(f"Namespace(sh_degree=3, {stored})")
    return folder


def files_of(model: Path) -> list[dict]:
    return [json.loads((model / name).read_text()) for name in FILES]


@pytest.fixture
def model(tmp_path) -> Path:
    return make_model(tmp_path / "model")


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Run metrics.py without cached weights and network; return (status, stdout, stderr)."""

    def command(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["metrics.py", *map(str, arguments)])
        monkeypatch.setenv("TORCH_HOME", str(tmp_path / "cache"))
        monkeypatch.setenv("GS_DOWNLOAD", "0")
        status = 0
        try:
            run_cli(metrics.main)
        except SystemExit as stop:
            status = stop.code
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err
        return status, captured.out, captured.err

    return command


@pytest.fixture
def lpips(monkeypatch):
    """A stand-in for LPIPS: the mean difference in the range that the network gets, and half as much by AlexNet."""

    def network(net: str, weights: Path, device: torch.device):
        assert weights == Path("weights")
        part = {"vgg": 1.0, "alex": 0.5}[net]
        return lambda x, y, normalize: part * (1 + normalize) * float((x - y).abs().mean())

    monkeypatch.setattr(metrics, "load_network", network)
    return ["--lpips_net", "both", "--weights", "weights"]


def test_psnr_is_scikit_images_from_one_error_over_channels():
    truth = picture(1)
    render = noisy(truth, 2)
    assert metrics.psnr(render, truth) == pytest.approx(peak_signal_noise_ratio(truth, render), abs=1e-9)
    assert metrics.psnr(truth, truth) is None
    assert metrics.mean({"a": 20.0, "b": None, "c": 30.0}) == 25.0 and metrics.mean({"a": None}) is None
    black = np.zeros((4, 4, 3), np.uint8)
    render = black + np.array([51, 0, 0], np.uint8)  # 0.2 in one channel of three: mean squared error 0.04 / 3
    assert metrics.psnr(render, black) == pytest.approx(-10 * math.log10(0.04 / 3), abs=1e-9)


def test_ssim_is_scikit_images_inside_and_zero_padded_at_the_border():
    truth = picture(3)
    render = noisy(truth, 4)
    options = {"data_range": 1.0, "channel_axis": 2, "gaussian_weights": True, "sigma": 1.5}
    options |= {"use_sample_covariance": False, "full": True}
    # scikit-image reflects at borders. With black rims of the window's radius, both see zeros there.
    padded = [np.pad(image, ((5, 5), (5, 5), (0, 0))) / 255.0 for image in (render, truth)]
    _, full = structural_similarity(*padded, **options)
    assert metrics.ssim(render, truth) == pytest.approx(full[5:-5, 5:-5].mean(), abs=1e-9)
    assert metrics.ssim(picture(1, 5, 7), picture(1, 5, 7)) == pytest.approx(1, abs=1e-12)  # below the window


def test_renders_of_an_earlier_model_are_refused(model):
    ply = model / "point_cloud/iteration_30/point_cloud.ply"
    ply.parent.mkdir(parents=True)
    ply.write_bytes(b"now")
    for known in (None, hashlib.sha256(b"now").hexdigest()):
        rendered_from(model, known)
        metrics.evaluate([model])
    rendered_from(model, hashlib.sha256(b"then").hexdigest())
    with pytest.raises(UserError, match="shows an earlier model than the one saved now; run render.py"):
        metrics.evaluate([model])


def rendered_from(model: Path, digest: str | None) -> None:
    (model / "test/ours_30/render_times.json").write_text(json.dumps({"model_sha256": digest}))


def test_files_by_contract_and_lpips_scored_before_is_kept(model, lpips, run, monkeypatch):
    status, out, _ = run("-m", model, *lpips)
    assert status == 0 and "warning" not in out
    assert (model / "results.json").read_text().startswith('{\n "ours_30": {\n  "SSIM": ')
    before = results, per_view, info = files_of(model)
    keys = ["SSIM", "PSNR", "LPIPS", "LPIPS_vgg", "LPIPS_alex"]
    assert list(results) == list(per_view) == ["ours_30"]
    assert list(results["ours_30"]) == list(per_view["ours_30"]) == keys
    for key in keys:
        values = per_view["ours_30"][key]
        assert list(values) == ["00000.png", "00001.png"]
        assert results["ours_30"][key] == pytest.approx(sum(values.values()) / 2)
    plain, mapped, alex = (results["ours_30"][key] for key in keys[2:])
    assert 0 < plain == pytest.approx(mapped / 2) == pytest.approx(alex)  # LPIPS takes images in [0, 1] as they are
    assert set(info["conventions"]) == set(keys) and info["views"] == {"ours_30": 2} and info["trained_with_eval"]

    # Without weights, what was scored before is kept, unless a render has changed.
    monkeypatch.undo()
    status, out, _ = run("-m", model)
    assert status == 0 and files_of(model) == list(before)
    assert "kept LPIPS, LPIPS_vgg, LPIPS_alex of an earlier scoring of the same pictures" in out
    Image.fromarray(picture(5)).save(model / SECOND)
    status, out, _ = run("-m", model)
    assert status == 0 and "kept" not in out
    scores = files_of(model)[0]["ours_30"]
    assert scores["LPIPS"] is None and "LPIPS_alex" not in scores and scores["PSNR"] > 0


def test_a_model_without_renders_is_named_and_the_others_are_scored(tmp_path, run):
    good, unrendered = make_model(tmp_path / "good"), tmp_path / "unrendered"
    unrendered.mkdir()
    status, out, err = run("-m", unrendered, good)
    assert status == 2 and f"{good} ours_30 (2 views): SSIM" in out and files_of(good)[0]["ours_30"]["PSNR"] > 0
    assert "no rendered test views in" in err and "unrendered" in err


def test_error_maps_are_black_where_nothing_counts_and_the_worst_views_are_named(model, run):
    method, mask = model / "test/ours_30", np.zeros((40, 56, 3), np.uint8)
    mask[:, 28:] = 255
    (method / "masks").mkdir()
    Image.fromarray(mask).save(method / "masks" / "00001.png")
    (model / "cameras.json").write_text('[{"img_name": "a.jpg"}, {"img_name": "b.jpg"}]')
    _, said, _ = run("-m", model, "--error_maps")
    psnrs = {name: value for name, value in files_of(model)[1]["ours_30"]["PSNR"].items()}
    names = sorted(psnrs, key=psnrs.get)
    worst = ", ".join(f"{'ab'[int(name[4])]}.jpg {psnrs[name]:.2f} dB" for name in names)
    assert f"worst views: {worst}\n" in said
    found = np.asarray(Image.open(method / "errors/00001.jpg").convert("L")).astype(int)
    truth, render = (np.asarray(Image.open(method / side / "00001.png")).astype(int) for side in ("gt", "renders"))
    expected = np.minimum(GAIN * np.abs(truth - render), 255).astype(np.uint8)
    grey = np.asarray(Image.fromarray(expected).convert("L")).astype(int)
    assert found[:, :16].max() < 8 and np.abs(found - grey)[:, 36:].mean() < 6 < grey[:, 36:].mean()  # of a JPEG


def test_images_of_two_folders_as_tensors(model):
    folder = model / "test" / "ours_30"
    Image.fromarray(picture(9)).convert("RGBA").save(folder / "gt" / "00001.png")
    renders, truths, names = metrics.readImages(folder / "renders", str(folder / "gt"))
    assert names == ["00000.png", "00001.png"]
    for side, images in (("renders", renders), ("gt", truths)):
        for name, image in zip(names, images, strict=True):
            assert image.shape == (1, 3, 40, 56) and image.dtype == torch.float32 and image.is_contiguous()
            assert image.device.type == compute_device().type
            with Image.open(folder / side / name) as file:
                pixels = np.asarray(file.convert("RGB"), dtype=np.float32)
            np.testing.assert_array_equal(image[0].cpu().numpy().transpose(1, 2, 0), pixels / 255)


def test_without_weights_or_package_lpips_is_null_and_says_what_to_do(tmp_path, run, monkeypatch):
    model = make_model(tmp_path / "model", stored="eval=False")
    status, out, _ = run("-m", model)
    said = "cannot compute LPIPS, LPIPS_vgg (null unless scored before): GS_DOWNLOAD=0 forbids downloading"
    assert status == 0 and out.count(said) == 1
    assert str(tmp_path / "cache" / "hub" / "checkpoints") in out and "without --eval" in out
    results, per_view, _ = files_of(model)
    assert results["ours_30"]["LPIPS"] is None and results["ours_30"]["PSNR"] > 20
    assert per_view["ours_30"]["LPIPS"] == {"00000.png": None, "00001.png": None}

    # A call of the function gives the files of the command.
    second = make_model(tmp_path / "second", stored="eval=False")
    assert metrics.evaluate([str(second)]) is None
    assert [(second / name).read_bytes() for name in FILES] == [(model / name).read_bytes() for name in FILES]

    monkeypatch.setitem(sys.modules, "lpips", None)
    status, out, _ = run("-m", model, "--lpips_net", "both", "--weights", tmp_path)
    assert status == 0 and out.count("import of lpips halted; None in sys.modules; run pip install") == 2


def test_stlpips_is_kept_and_without_its_package_refused(model, run, lpips, monkeypatch):
    monkeypatch.setitem(sys.modules, "stlpips_pytorch.stlpips", None)
    status, _, err = run("-m", model, "--stlpips", *lpips)
    assert status == 2 and err.startswith("error: ST-LPIPS needs the package stlpips-pytorch (")
    assert not (model / "results.json").exists()
    assert err.endswith("); `pip install '.[stlpips]'`\n")

    monkeypatch.setattr(metrics, "load_stlpips", lambda _: lambda x, y, normalize: 2 * normalize)
    assert run("-m", model, "--stlpips", *lpips)[0] == 0
    results, _, info = files_of(model)
    assert results["ours_30"]["STLPIPS"] == 2.0 and "stlpips-pytorch" in info["conventions"]["STLPIPS"]
    assert "kept STLPIPS of an earlier" in run("-m", model, *lpips)[1]
    assert files_of(model)[0] == results


def emptied(model: Path, *folders: str) -> None:
    for file in model.glob("test/*/*/*.png"):
        file.unlink()
    for folder in folders:
        (model / "test" / "ours_30" / folder).rmdir()


def without_test(model: Path, stored: str = "eval=True") -> None:
    shutil.rmtree(model / "test")
    (model / "cfg_args").write_text(f"Namespace({stored})")


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda model: (model / SECOND).unlink(), "00001.png is in gt but not in renders"),
        (lambda model: Image.fromarray(picture(0, 20, 20)).save(model / SECOND), r"00001.png has \(20, 20\) pixels"),
        (
            lambda model: (model / SECOND).write_bytes((model / SECOND).read_bytes()[:-200]),
            "00001.png is missing or damaged",
        ),
        (lambda model: (model / "test/ours_30" / INCOMPLETE).touch(), "ours_30 was interrupted; run render.py again"),
        (emptied, "no images"),
        (lambda model: emptied(model, "renders"), "renders is missing"),
        (without_test, "no rendered test views .*; run render.py"),
        (
            lambda model: (without_test(model), (model / "cfg_args").unlink()),
            "no rendered test views .*; pass a model folder that render.py has written into",
        ),
        (lambda model: without_test(model, "eval=False"), "no rendered test views .*without --eval"),
        (shutil.rmtree, "no such model folder: .*; pass one"),
    ],
)
def test_what_cannot_be_scored_is_said_before_a_file_is_written(model, damage, words):
    damage(model)
    with pytest.raises(UserError, match=words):
        metrics.evaluate([model])
    assert not list(model.glob("*.json"))
