"""Exposures: names, schedule, files, checkpoints, and the half-image protocol that trains them."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from gaussians import model, options, take_steps
from PIL import Image
from trainings import leaves

import render
import train
from scene.dataset_readers import CameraInfo, read_scene
from scene.gaussian_model import GaussianModel
from scene.gaussians.checkpoint import EXPOSURES, WRITTEN_BY, extra_state, load_checkpoint, save_checkpoint
from scene.gaussians.exposure import Exposures, read_exposures
from scene.readers.info import exposure_names
from splatting.features.exposure import train_on_all
from splatting.records.error_curve import read_curve
from splatting.registry import states_in
from utils.general_utils import get_expon_lr_func
from utils.loss_utils import inverse_depth_loss, l1_loss, photometric_loss, ssim
from utils.system_utils import UserError

NAMES = ["b.png", "a.png", "left/c.png"]
GAIN = 0.6  # of every third photo


def _infos(*paths: str, stems: bool = False) -> list[CameraInfo]:
    info = CameraInfo(0, np.eye(3), np.zeros(3), fx=9.0, fy=9.0, width=8, height=6)
    return [
        replace(info, image_path=Path("/scene", path), image_name=Path(path).stem if stems else path) for path in paths
    ]


def _read(folder: Path, infos: list[CameraInfo]) -> Exposures:
    return read_exposures(folder, exposure_names(infos), [info.image_name for info in infos])


def _trained(names: list[str] = NAMES, steps: int = 3, **changes: object) -> Exposures:
    exposures = Exposures(names)
    exposures.training_setup(options(iterations=100, **changes))
    generator = torch.Generator().manual_seed(0)
    for step in range(1, steps + 1):
        exposures.update_learning_rate(step)
        exposures.values.grad = torch.randn(len(names), 3, 4, generator=generator)
        exposures.step()
    return exposures


def test_names_clash_only_where_they_are_made_to():
    assert exposure_names(_infos(*NAMES)) == NAMES
    blender = _infos("train/r_0.png", "train/r_1.png", "test/r_0.png", stems=True)
    assert exposure_names(blender) == ["train/r_0.png", "r_1", "test/r_0.png"]
    assert exposure_names([]) == []


def test_the_optimiser_has_the_references_schedule_and_torchs_constants():
    exposures = _trained(steps=0, exposure_lr_delay_steps=50, exposure_lr_delay_mult=0.1)
    rate = get_expon_lr_func(0.01, 0.001, 50, 0.1, max_steps=100)
    for t in (0, 30, 100):
        exposures.update_learning_rate(t)
        assert exposures.optimizer.param_groups[0]["lr"] == rate(t)
    theirs = torch.optim.Adam([torch.zeros(1)]).defaults
    assert all(exposures.optimizer.defaults[name] == theirs[name] for name in ("betas", "eps"))


# exposure.json


def test_the_file_comes_back(tmp_path):
    exposures = _trained()
    exposures.write(tmp_path)
    table = json.loads((tmp_path / "exposure.json").read_text())
    assert list(table) == NAMES and np.shape(table["a.png"]) == (3, 4)
    again = _read(tmp_path, _infos(*NAMES[::-1]))
    assert again.names == NAMES[::-1] and not again.trained
    for name in NAMES:
        assert torch.equal(again[name], exposures[name]) and exposures[name].tolist() == table[name]


def test_names_that_others_did_not_tell_apart_are_found(tmp_path):
    rows = [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0.5]]
    (tmp_path / "exposure.json").write_text(json.dumps({"r_0": rows}))
    exposures = _read(tmp_path, _infos("train/r_0.png", "test/r_0.png", stems=True))
    assert exposures["train/r_0.png"].tolist() == exposures["test/r_0.png"].tolist() == rows


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "cannot read .*exposure.json"),
        ("{", "is not JSON"),
        ("[1]", "is not a table of exposures"),
        ("{}", "has no exposure of a.png"),
        ('{"a.png": [[1, 0, 0, 0]]}', "is not 3 x 4 finite numbers"),
        ('{"a.png": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, NaN]]}', "is not 3 x 4 finite numbers"),
        ('{"a.png": "white"}', "is not a matrix of numbers"),
        ('{"a.png": [[1, 0], [1]]}', "is not a matrix of numbers"),
    ],
)
def test_a_broken_file_is_named(tmp_path, text, words):
    if text is not None:
        (tmp_path / "exposure.json").write_text(text)
    with pytest.raises(UserError, match=f"{words}.*; restore the file, or leave --appearance affine out and write"):
        _read(tmp_path, _infos("a.png"))


# The reference's names


def test_parts_can_be_read_and_replaced_by_the_references_names():
    gaussians = model(6)
    gaussians.exposures = _trained()
    assert gaussians._exposure is gaussians.get_exposure is gaussians.exposures.values
    assert gaussians.exposure_mapping == {name: index for index, name in enumerate(NAMES)}
    assert gaussians.pretrained_exposures is None and gaussians.exposure_optimizer is gaussians.exposures.optimizer
    gaussians.exposure_mapping = {"x": 1, "y": 0}
    gaussians._exposure = torch.nn.Parameter(torch.rand(2, 3, 4))
    assert torch.equal(gaussians.get_exposure_from_name("x"), gaussians._exposure[1])
    assert gaussians.exposures.names == ["y", "x"]
    gaussians.exposure_optimizer = torch.optim.Adam([gaussians._exposure], lr=0.5)
    gaussians.exposure_scheduler_args = lambda iteration: 0.125 * iteration
    gaussians.update_learning_rate(2)
    before = gaussians._exposure.detach().clone()
    gaussians._exposure.grad = torch.ones(2, 3, 4)
    gaussians.step(torch.ones(6, dtype=torch.int32))
    torch.testing.assert_close(gaussians._exposure, before - 0.25)
    maps = {"x": torch.rand(3, 4)}
    gaussians.pretrained_exposures = maps
    assert gaussians.get_exposure_from_name("x") is maps["x"]
    gaussians.update_learning_rate(3)
    assert gaussians.exposure_optimizer.param_groups[0]["lr"] == 0.25  # they are not trained further
    with pytest.raises(UserError, match="no trained exposure of y"):
        gaussians.get_exposure_from_name("y")


def test_a_ply_brings_the_exposures_of_its_model_folder(tmp_path, capsys):
    gaussians = model(6)
    gaussians.exposures = _trained()
    path = tmp_path / "point_cloud/iteration_7/point_cloud.ply"
    path.parent.mkdir(parents=True)
    gaussians.save_ply(path)
    loaded = GaussianModel(3)
    loaded.load_ply(path, use_train_test_exp=True)
    assert loaded.pretrained_exposures is None and "no exposures are loaded" in capsys.readouterr().out
    gaussians.save_exposures(tmp_path)
    loaded.load_ply(path)
    assert loaded.pretrained_exposures is None
    loaded.load_ply(str(path), True)
    assert list(loaded.pretrained_exposures) == NAMES
    for name in NAMES:
        assert torch.equal(loaded.get_exposure_from_name(name), gaussians.get_exposure_from_name(name))


# Checkpoints


def test_a_model_without_a_scene_takes_the_checkpoints_photos():
    gaussians, other = model(6), GaussianModel(3)
    gaussians.exposures = _trained()
    take_steps(gaussians, 1)
    other.restore(gaussians.capture(), options())
    assert list(other.exposure_mapping) == NAMES and torch.equal(other.get_exposure, gaussians.get_exposure)
    assert other.exposure_optimizer.state[other._exposure]["step"] == 3
    renamed = GaussianModel(3)
    renamed.start_exposures(_infos("d.png"))
    for names, each in ((NAMES, renamed), ("abc", GaussianModel(3)), ([["a"], "b", "c"], GaussianModel(3))):
        capture = list(gaussians.capture())
        capture[10][EXPOSURES]["names"] = names
        with pytest.raises(UserError, match="exposures are of other photos"):
            each.restore(capture, options())


def test_checkpoints_carry_them_within_the_references_entries(tmp_path):
    """In the optimiser's state; as a last entry of their own until 0.1.0."""
    gaussians, other = model(6), model(2)
    gaussians.exposures = _trained()
    take_steps(gaussians, 1)
    capture = gaussians.capture()
    assert len(capture) == len(model(6).capture()) == 12
    optimizer = dict(capture[10])
    save_checkpoint(tmp_path / "c.pth", (*capture[:10], optimizer, capture[11], optimizer.pop(EXPOSURES)), 5)
    other.exposures = Exposures(NAMES)
    other.restore(load_checkpoint(tmp_path / "c.pth")[0], options(iterations=100))
    assert other.exposures.trained and torch.equal(other.get_exposure, gaussians.get_exposure)
    states = [one.exposure_optimizer.state_dict()["state"] for one in (gaussians, other)]
    assert leaves(states[0]) == leaves(states[1])


def test_exposures_that_do_not_fit_are_refused():
    state = _trained().capture()
    cases = {
        "exposures are of other photos": state | {"names": NAMES[:2]},
        "3 x 4|float32": state | {"values": state["values"].double()},
        "optimiser state in the checkpoint does not fit": state | {"optimizer": 5},
        "the exposure of .* in the checkpoint is not finite; use another": state
        | {"values": torch.full_like(state["values"], torch.inf)},
    }
    for words, wrong in cases.items():
        with pytest.raises(UserError, match=words):
            _trained(steps=0).restore(wrong)
    with pytest.raises(UserError, match="exposures are of other photos"):
        _trained(["x.png"], steps=0).restore(state)
    Exposures().check_finite("iteration 7", "do this")
    broken = _trained()
    with torch.no_grad():
        broken.values[1, 0, 0] = torch.nan
    with pytest.raises(UserError, match="the exposure of a.png in iteration 7 is not finite; do this"):
        broken.check_finite("iteration 7", "do this")


# Loss on a part of the columns


def test_columns_that_do_not_count_are_cut_off():
    generator = torch.Generator().manual_seed(0)
    image, target = torch.rand(2, 3, 20, 31, generator=generator)
    image.requires_grad_()
    loss, l1 = photometric_loss(image, target, 0.2, columns=slice(0, 15))
    (gradient,) = torch.autograd.grad(loss, image)
    exact = image.detach().double().requires_grad_()
    left, wanted = exact[..., :15], target.double()[..., :15]
    plain = (0.8 * l1_loss(left, wanted) + 0.2 * (1 - ssim(left, wanted))) * 15 / 31
    (exact_gradient,) = torch.autograd.grad(plain, exact)
    assert abs(loss.item() - plain.item()) < 1e-5 and abs(l1.item() - l1_loss(left, wanted).item()) < 1e-6
    assert (gradient - exact_gradient).abs().max() < 1e-4 * exact_gradient.abs().max()
    assert not gradient[..., 15:].any() and gradient[..., :15].any()
    depth, mono = torch.rand(2, 1, 20, 31, generator=generator)
    mask = torch.arange(31) < 15
    assert torch.allclose(inverse_depth_loss(depth, mono, slice(0, 15)), ((depth - mono).abs() * mask).mean())
    assert torch.allclose(inverse_depth_loss(depth, mono), (depth - mono).abs().mean())
    counts = torch.rand(1, 20, 31, generator=generator) < 0.3
    broken = torch.where(counts, mono, torch.nan)
    expected = (depth - mono).abs()[counts].mean()
    assert torch.allclose(inverse_depth_loss(depth, broken, None, counts), expected)
    # A view of which only the left half trains has half the weight, whatever part of that half counts.
    left = (depth - mono).abs()[counts & mask].mean() * 15 / 31
    assert torch.allclose(inverse_depth_loss(depth, broken, slice(0, 15), counts), left)
    assert inverse_depth_loss(depth, mono, slice(0, 15), torch.zeros_like(counts)) == 0


# The half-image protocol


OPTIONS = [
    "-r", "32", "--eval", "--train_test_exp", "--test_iterations", "-1", "--densify_from_iter", "50",
    "--densification_interval", "40", "--densify_grad_threshold", "1e-4", "--max_num_splats", "450",
    "--exposure_lr_final", "0.01",
]  # fmt: skip


def _train(scene: Path, out: Path, *more: object, iterations: int = 200) -> Path:
    train.main(["-s", str(scene), "-m", str(out), "--iterations", str(iterations), *OPTIONS, *map(str, more)])
    return out / "point_cloud" / f"iteration_{iterations}" / "point_cloud.ply"


def _pictures(scene: Path) -> list[Path]:
    """The exposures in the order of the views."""
    return sorted((scene / "images").rglob("*.png"), key=lambda path: path.relative_to(scene).as_posix())


def test_all_views_train_in_the_order_of_their_names(colmap_scene, blender_scene):
    held = read_scene(colmap_scene, "images", True)
    info = train_on_all(held)
    whole = read_scene(colmap_scene, "images", False)
    names = [camera.image_name for camera in info.train_cameras]
    assert names == [camera.image_name for camera in whole.train_cameras]
    assert info.test_cameras == held.test_cameras and info.extent == whole.extent != held.extent
    blender = train_on_all(read_scene(blender_scene, "images", True))
    paths = [camera.image_path.relative_to(blender_scene).as_posix() for camera in blender.train_cameras]
    assert paths == [f"train/r_{i}.png" for i in range(4)] + ["test/r_0.png", "test/r_1.png"]


def test_from_pictures_of_different_exposure_to_scored_halves(colmap_scene, tmp_path, monkeypatch):
    pictures = _pictures(colmap_scene)
    for path in pictures[1::3]:
        dark = np.asarray(Image.open(path)) * GAIN
        Image.fromarray(dark.round().astype(np.uint8)).save(path)
    _train(colmap_scene, tmp_path / "a", "--checkpoint_iterations", 90, "--test_iterations", 200)

    # The exposures tell which photos are dark.
    table = json.loads((tmp_path / "a/exposure.json").read_text())
    names = [path.relative_to(colmap_scene / "images").as_posix() for path in pictures]
    assert sorted(table) == names
    gains = np.array([np.trace(np.array(table[name])[:, :3]) for name in names])
    dark = np.arange(len(names)) % 3 == 1
    assert gains[dark].max() < gains[~dark].min()

    more = "--start_checkpoint", str(tmp_path / "a/chkpnt90.pth")
    with pytest.raises(UserError, match="chkpnt90.pth was trained with --train_test_exp; give that option"):
        train.main(["-s", str(colmap_scene), "-m", str(tmp_path / "c"), "-r", "32", *more])

    # render.py and the curve use right halves.
    monkeypatch.setattr(sys, "argv", ["render.py", "-m", str(tmp_path / "a"), "--quiet"])
    render.main()
    scored = []
    for index, path in enumerate(pictures[::8]):
        shown, truth = (Image.open(tmp_path / f"a/test/ours_200/{side}/{index:05d}.png") for side in ("renders", "gt"))
        photo = np.asarray(Image.open(path).resize((32, 21), Image.Resampling.BICUBIC))
        np.testing.assert_array_equal(np.asarray(truth), photo[:, 16:])
        scored.append(-10 * np.log10(np.mean((np.asarray(shown) / 255 - np.asarray(truth) / 255) ** 2)))
    assert len(list((tmp_path / "a/train/ours_200/renders").iterdir())) == 17
    (row,) = read_curve(tmp_path / "a/error_vs_time.csv")[-1:]
    assert row["test_psnr"] == pytest.approx(np.mean(scored), abs=0.05)  # only these renders are rounded to 8 bits


def test_what_is_scored_does_not_train(colmap_scene, tmp_path):
    plain = _train(colmap_scene, tmp_path / "a", iterations=40)
    pictures = _pictures(colmap_scene)
    changed = {path: np.array(Image.open(path)) for path in pictures[::8]}
    for path, pixels in changed.items():
        pixels[:, 64:] = 255 - pixels[:, 64:]  # only a third, so that resizing does not affect the left half
        Image.fromarray(pixels).save(path)
    assert _train(colmap_scene, tmp_path / "b", iterations=40).read_bytes() == plain.read_bytes()
    for path, pixels in changed.items():
        pixels[:, :32] = 255 - pixels[:, :32]
        Image.fromarray(pixels).save(path)
    assert _train(colmap_scene, tmp_path / "c", iterations=40).read_bytes() != plain.read_bytes()


@pytest.mark.parametrize("damaged", [[{}], 5, {"kind": []}])
def test_what_is_no_state_of_exposures_is_none(damaged):
    assert states_in(extra_state((*[None] * 10, {WRITTEN_BY: "1", EXPOSURES: damaged}, 1.0))) == {}
