"""A number can be trusted: log, curve, metrics.py and an independent score of the PNGs agree, whatever the options."""

import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio
from synthetic import make_blender_scene
from trainings import narrow_scene, train_on

import metrics
import render
from arguments import OPTIONS
from splatting.records.error_curve import read_curve

ITERATIONS = 12
NEAR = 0.02  # dB; PNGs are rounded to 8 bits, which adds an error of 1/12 of their unit squared
SETS = {
    "plain": (),
    "ignored": ("--masks", "masks", "--random_background", "-w", "--sh_degree", 1),
    "transparent": ("--masks", "masks", "--invert_masks", "--mask_meaning", "transparent", "-w", "-r", 2),
    "halves": ("--train_test_exp", "--masks", "masks", "--antialiasing", "--projection", "ray"),
    "affine": (
        *("--appearance", "affine", "-d", "depths", "--prune_sh", 0),
        *("--lenses", "native", "--antialiasing", "--optimizer_type", "sparse_adam"),
    ),
    "ppisp": ("--appearance", "ppisp", "--sparse_depth", 0.5, "--lenses", "undistort", "--masks", "masks"),
    "poses": ("--refine_poses", "--robust_mask", 0.2, "--sky", "auto", "--strategy", "budget", "--images_to_load", 5),
    "in PyTorch": (
        *("--convert_SHs_python", "--compute_cov3D_python", "--strategy", "mcmc", "-i", "images/."),
        *("--holdout", "sector"),
    ),
    "RGBA on white": ("-w", "--mask_meaning", "ignore"),
}
OWN = {"ignored": 20, "ppisp": None, "affine": None, "RGBA on white": None}  # first columns that count; None: others
# Options that change how well a model trains, or what is written, but not what is drawn or compared.
OTHERS = {
    *("source_path", "model_path", "data_device", "eval", "init_type", "init_pcd_path", "init_ply", "debug", "seed"),
    *("position_lr_init", "position_lr_final", "position_lr_delay_mult", "position_lr_max_steps", "feature_lr"),
    *("opacity_lr", "scaling_lr", "rotation_lr", "exposure_lr_init", "exposure_lr_final", "exposure_lr_delay_steps"),
    *("exposure_lr_delay_mult", "percent_dense", "lambda_dssim", "densification_interval", "opacity_reset_interval"),
    *("densify_from_iter", "densify_until_iter", "densify_grad_threshold", "depth_l1_weight_init"),
    *("depth_l1_weight_final", "gpu_memory", "max_num_splats", "keep_unseen"),
    *("absgrad", "absgrad_threshold", "split", "mcmc_until_iter", "mcmc_growth", "mcmc_min_opacity"),
    *("mcmc_noise", "mcmc_opacity_reg", "mcmc_scale_reg"),
    *("mcmc_init_opacity", "mcmc_init_scale", "opacity_decay", "iterations"),
    *("prune_opacity", "time_budget", "schedule"),
}


def test_every_option_is_classified():
    words = [word for of_set in SETS.values() for word in of_set if isinstance(word, str) and word.startswith("-")]
    by_letter = {f"-{option.short}": option.name for option in OPTIONS if option.short}
    tried = {by_letter.get(word, word.lstrip("-")) for word in words}
    assert {option.name for option in OPTIONS} - tried - OTHERS == set()
    assert not tried & OTHERS


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> dict[bool, Path]:
    """Scenes of COLMAP, through a lens, and of Blender with RGBA photos."""
    folder = tmp_path_factory.mktemp("scenes")
    make_blender_scene(folder / "rgba", views=6)
    narrow_scene(folder / "photos", "OPENCV", (-0.05, 0.01, 0.0, 0.0))
    return {True: folder / "rgba", False: folder / "photos"}


@pytest.mark.parametrize("name", SETS)
def test_all_places_have_one_number(scenes, tmp_path, monkeypatch, capsys, name):
    words = "--eval", "--iterations", ITERATIONS, "--test_iterations", ITERATIONS, "--disable_viewer"
    scene = scenes[name.startswith("RGBA")]
    train_on(scene, tmp_path, *words, *SETS[name])
    said = capsys.readouterr().out
    for command, *more in ((render, "--skip_train"), (metrics,)):
        monkeypatch.setattr(sys, "argv", ["x", "-m", str(tmp_path), *more])
        command.main()
    method = tmp_path / "test" / f"ours_{ITERATIONS}"
    scored = json.loads((tmp_path / "results.json").read_text())[method.name]["PSNR"]
    curve = read_curve(tmp_path / "error_vs_time.csv")[-1]["test_psnr"]
    independent = np.mean([_psnr(method, path.name, OWN.get(name, 0)) for path in sorted((method / "gt").iterdir())])
    printed = float(said.split("Evaluating test:")[1].split("channels'; ")[1].split(" ")[0])
    last = float(said.split("Test PSNR ")[-1].split(" dB")[0])
    numbers = {"metrics": scored, "curve": curve, "log": printed, "last line": last, "independent": independent}
    assert all(math.isfinite(number) and abs(number - independent) < NEAR for number in numbers.values()), numbers
    by_channel = json.loads((tmp_path / "train_log.json").read_text())[-1]["test_psnr"]
    assert f"PSNR {by_channel:.3f} (" in said


def _psnr(method: Path, name: str, own: int | None) -> float:
    """The PSNR of two PNGs where their mask is white, which is from column `own` on, if that is known."""
    truth, shown = (np.asarray(Image.open(method / side / name).convert("RGB")) for side in ("gt", "renders"))
    mask = method / "masks" / name
    counts = np.asarray(Image.open(mask)) > 0 if mask.is_file() else np.ones(truth.shape[:2], bool)
    if own is not None:
        assert np.array_equal(counts, np.broadcast_to(np.arange(counts.shape[1]) >= own, counts.shape))
    return peak_signal_noise_ratio(truth[counts], shown[counts])
