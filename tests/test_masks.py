"""Masks: their files, and their two meanings in loss, views, renders and scores."""

import json
import os
import shutil
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from fused_ssim.reference import ssim_map
from PIL import Image
from synthetic import HEIGHT, WIDTH, FakeGaussians, folder_state, options_of, read
from torch import Tensor

import metrics
import render
import train
from scene import Scene
from scene.images.decode import decode
from scene.images.masks import TRANSPARENT, Mask, MaskOptions, find_masks
from scene.readers.photos import _check_mask
from splatting.watch import MaskWatch
from utils.image_utils import pixels_that_count
from utils.loss_utils import photometric_loss
from utils.system_utils import UserError


def _pair(seed: int = 0, size: tuple[int, int] = (37, 53)) -> tuple[Tensor, Tensor, Tensor]:
    """An image, a target and a mask with a large hole, a small hole and single pixels."""
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(3, *size, generator=generator)
    target = (image + 0.2 * torch.randn(3, *size, generator=generator)).clamp(0, 1)
    mask = torch.ones(1, *size, dtype=torch.bool)
    mask[:, 10:30, 20:45] = False
    mask[:, 3, 4:9] = False
    mask &= torch.rand(1, *size, generator=generator) > 0.02
    return image, target, mask


@pytest.mark.parametrize(("weight", "as_bytes"), [(0.0, False), (0.2, True), (1.0, False)])
def test_loss_and_gradient_are_those_of_the_definition(weight, as_bytes):
    image, target, mask = _pair()
    if as_bytes:
        target = (target * 255).round().to(torch.uint8)
    image.requires_grad_()
    loss, l1 = photometric_loss(image, target, weight, mask)
    loss.backward()

    exact = image.detach().double().requires_grad_()
    truth = target.double() / 255 if as_bytes else target.double()
    pixels = 3 * mask.sum()
    expected_l1 = ((exact - truth).abs() * mask).sum() / pixels
    dissimilarity = (1 - ssim_map(exact * mask, truth * mask)).sum() / pixels
    expected = (1 - weight) * expected_l1 + weight * dissimilarity
    expected.backward()
    # The error of float32: 1 - SSIM is a difference of numbers near 1, then multiplied by 1.4 for the masked pixels.
    assert loss.item() == pytest.approx(expected.item(), abs=1e-5)
    assert l1.item() == pytest.approx(expected_l1.item(), abs=1e-6)
    assert (image.grad - exact.grad).abs().max() < 1e-5 * exact.grad.abs().max()
    assert (image.grad[:, ~mask[0]] == 0).all()


def test_masks_that_leave_out_nothing_or_everything():
    image, target, mask = _pair()
    assert photometric_loss(image, target, 0.2, torch.ones_like(mask)) == photometric_loss(image, target, 0.2)
    image.requires_grad_()
    loss, l1 = photometric_loss(image, target, 0.2, torch.zeros_like(mask))
    loss.backward()
    assert loss == l1 == 0 and (image.grad == 0).all()
    assert pixels_that_count(image, torch.zeros_like(mask)).tolist() == [[0], [0], [0]]
    assert torch.equal(pixels_that_count(image, mask), image[:, mask[0]])
    assert pixels_that_count(image, None) is image


def _save(path: Path, grey: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(grey).save(path)
    return path


def test_black_is_dark(tmp_path):
    grey = np.full((8, 8), 255, np.uint8)
    grey[0, 0], grey[5, 4], grey[7, 7] = 0, 127, 128
    path = _save(tmp_path / "m.png", grey)
    pixels = Mask(path).decode((8, 8))
    assert pixels.shape == (1, 8, 8) and pixels.dtype == torch.uint8 and set(pixels.unique().tolist()) == {0, 255}
    assert (pixels[0] == 0).nonzero().tolist() == [[0, 0], [5, 4]]
    assert torch.equal(Mask(path, inverted=True).decode((8, 8)), 255 - pixels)
    cutout = np.zeros((6, 6, 4), np.uint8)
    cutout[2:4, 2:4] = (10, 0, 0, 255)  # by its alpha
    pixels = Mask(_save(path, cutout)).decode((6, 6))[0]
    assert pixels.sum() == 4 * 255 and (pixels[2:4, 2:4] == 255).all()


@pytest.mark.parametrize(
    ("dtype", "values", "white"),
    [
        (np.uint16, (0, 1), 1),
        (np.uint16, (0, 255), 255),
        (np.uint16, (0, 65535), 65535),
        (np.uint16, (0, 40_000), 40_000),
        (np.uint8, (0, 1), 1),
        (np.uint8, (0, 3), 3),
        (np.uint8, (0, 100), 100),
        (np.uint8, (1, 0, 2, 3), 1),
        (np.uint8, (0, 0), 1),
    ],
)
def test_the_values_of_a_mask_tell_what_is_white_in_it(tmp_path, dtype, values, white):
    labels = np.array(values, dtype)[np.arange(64).reshape(8, 8) * len(values) // 64]
    pixels = Mask(_save(tmp_path / "m.png", labels)).decode((8, 8))[0].numpy()
    np.testing.assert_array_equal(pixels, np.where(labels >= white, 255, 0))


def test_a_dark_grey_mask_with_soft_edges_is_bright_and_noise_is_black(tmp_path):
    wide = np.zeros((64, 64))
    wide[:, 32:] = 100
    wide[:, 30:34] = (20, 40, 60, 80)
    pixels = Mask(_save(tmp_path / "m.jpg", wide.astype(np.uint8))).decode((64, 64))[0].numpy()
    assert (pixels[:, :29] == 0).all() and (pixels[:, 35:] == 255).all()
    noise = np.random.default_rng(0).integers(0, 4, (64, 64))
    for name, grey in (("m.jpg", noise), ("m.png", np.tile(np.linspace(60, 0, 64), (64, 1)))):
        assert not Mask(_save(tmp_path / name, grey.astype(np.uint8))).decode((64, 64)).any()


@pytest.mark.parametrize("size", [(60, 45), (23, 17), (240, 180)])
def test_at_other_sizes_what_counts_is_free_of_what_is_masked(tmp_path, size):
    mask = np.full((90, 120), 255, np.uint8)
    mask[30:45, 50:83] = 0
    picture = np.random.default_rng(0).integers(0, 256, (90, 120, 3), dtype=np.uint8)
    other = np.where(mask[..., None] == 255, picture, 255 - picture)
    counts = Mask(_save(tmp_path / "m.png", mask)).decode(size)[0] == 255
    one, two = (decode(_save(tmp_path / f"{i}.png", p), size) for i, p in enumerate((picture, other)))
    same = (one == two).all(dim=0)
    assert (counts <= same).all()
    # Only necessary pixels are lost: 2 and a fraction, at the coarser size, around the masked 33 x 15.
    scale = min(size[0] / 120, 1)
    assert (~counts).sum() <= (max(size[0] / 120, 1)) ** 2 * (33 * scale + 6) * (15 * scale + 6)


def test_soft_edges_are_kept_where_they_mean_alpha(tmp_path):
    path = _save(tmp_path / "m.png", np.arange(0, 64, dtype=np.uint8).reshape(8, 8) * 4)
    pixels = Mask(path, meaning=TRANSPARENT).decode((8, 8))[0].numpy()
    np.testing.assert_array_equal(pixels, np.arange(0, 256, 4).reshape(8, 8))
    np.testing.assert_array_equal(255 - pixels, Mask(path, True, TRANSPARENT).decode((8, 8))[0].numpy())


@pytest.fixture
def masked_scene(colmap_scene) -> Path:
    """Write masks for all 17 photos, named in several ways, whose left third is black."""
    for index, camera in enumerate(read(colmap_scene).train_cameras):
        name = Path(camera.image_name)
        grey = np.full((HEIGHT, WIDTH), 255, np.uint8)
        grey[:, : WIDTH // 3] = 0
        ways = [name, Path(f"{name}.png"), name.with_suffix(".PNG"), name.with_suffix(".jpg"), Path(str(name).upper())]
        _save(colmap_scene / "masks" / ways[index % 5], grey)
    return colmap_scene


def _views(scene: Path, **options) -> list:
    return Scene(options_of(scene, scene.parent / "out", **options), FakeGaussians(), shuffle=False).getTrainCameras()


def test_masks_are_found_by_the_names_of_the_pictures(masked_scene, capsys):
    before = folder_state(masked_scene)
    assert all(view.counted_pixels is None for view in _views(masked_scene))
    capsys.readouterr()
    views = _views(masked_scene, masks="masks")
    for view in views:
        assert view.counted_pixels.dtype == torch.bool and view.counted_pixels.shape == (1, HEIGHT, WIDTH)
        assert view.counted_pixels[:, :, 32:].all() and not view.counted_pixels[:, :, :32].any()
        assert view.target(torch.zeros(3)).dtype == torch.uint8
    assert capsys.readouterr().err == ""
    for view in _views(masked_scene, masks=str(masked_scene / "masks"), invert_masks=True, resolution=48):
        assert not view.counted_pixels[:, :, 14:].any() and view.counted_pixels[:, :, :14].all()
    assert folder_state(masked_scene) == before

    next(masked_scene.rglob("masks/left/*.png.png")).unlink()
    (lacking,) = [view.image_name for view in _views(masked_scene, masks="masks") if view.counted_pixels is None]
    assert f"1 of 17 photos have no mask; all their pixels count: {lacking}" in capsys.readouterr().err


@pytest.mark.parametrize("mask", ["x.jpg.mask.png", "x.mask.png", "x_mask.png", "x.jpg_mask.png", "x_mask.JPG"])
def test_masks_have_the_names_that_tools_give_them(tmp_path, mask):
    assert _of_photos(tmp_path, ["a/x.jpg"], [f"a/{mask}"]) == [f"a/{mask}"]


def _of_photos(tmp_path: Path, names: list[str], masks: list[str], folder: str = "masks") -> list[Path | None]:
    """Masks in a folder of photos whose names count from the folder images."""
    photos = [tmp_path / "images" / name for name in names]
    for path in photos:
        _save(path, np.full((8, 8), 200, np.uint8))
    for name in masks:
        _save(tmp_path / "masks" / name, np.zeros((8, 8), np.uint8))
    found = find_masks(tmp_path, names, MaskOptions(folder), photos, "images")
    return [mask and mask.path.relative_to(tmp_path / "masks").as_posix() for mask in found]


@pytest.mark.parametrize("prefix", ["", "../images/", "{}/images/", "./"])
@pytest.mark.parametrize("deep", ["left/1.png", "images/left/1.png", "left/1.png.png"])
def test_masks_are_found_below_their_folder_wherever_photos_are_said_to_be(tmp_path, prefix, deep, capsys):
    names = [prefix.format(tmp_path) + name for name in ("left/1.png", "right/1.png", "right/2.png")]
    names = [f"images/{name}" for name in names] if deep.startswith("images") and prefix in ("", "./") else names
    masks = [deep, "right/2.png"] if not deep.startswith("images") else [deep.removeprefix("images/")]
    assert _of_photos(tmp_path, names, masks)[:2] == [masks[0], None]
    assert "1 of 3 photos have no mask" in capsys.readouterr().err or len(masks) == 1


def test_a_bare_name_is_used_where_one_photo_and_one_mask_have_it(tmp_path, capsys):
    names = ["left/1.png", "right/1.png", "right/2.png", "right/3.png"]
    found = _of_photos(tmp_path, names, ["1.png", "2.png", "deep/3.png"])
    assert found == [None, None, "2.png", "deep/3.png"]
    assert "1 masks lie in other sub-folders than their photos" in capsys.readouterr().err


@pytest.mark.parametrize("way", ["absolute", "link", "hard link", "copy", "folder of photos"])
def test_a_photo_is_not_its_own_mask(tmp_path, way):
    photo = _save(tmp_path / "images" / "x.png", np.full((8, 8), 200, np.uint8))
    (tmp_path / "masks").mkdir()
    mask, folder = tmp_path / "masks" / "x.png", "masks"
    if way == "folder of photos":
        folder = "images"
    elif way != "absolute":
        {"link": os.symlink, "hard link": os.link, "copy": shutil.copyfile}[way](photo, mask)
    words = "no mask in .* belongs" if way == "absolute" else "contains the photos .*x.png. and no masks"
    with pytest.raises(UserError, match=words):
        _of_photos(tmp_path, [str(photo)], [], folder)
    _save(tmp_path / folder / "x.png.png", np.zeros((8, 8), np.uint8))
    assert find_masks(tmp_path, [str(photo)], MaskOptions(folder), [photo])[0].path.name == "x.png.png"


def test_masks_of_several_photos_are_refused(blender_scene):
    for name in ("r_0", "r_1"):
        _save(blender_scene / "masks" / f"{name}.png", np.zeros((30, 40), np.uint8))
    with pytest.raises(UserError, match="2 masks belong to several photos each, the first is .*r_0.png for .*sub-fold"):
        _views(blender_scene, masks="masks")


def test_a_transparent_mask_is_alpha(masked_scene):
    first = _views(masked_scene)[0]
    pixels = np.asarray(Image.open(first.image_path)).copy()
    smooth = _views(masked_scene, resolution=48)[0].target(torch.zeros(3))
    pixels[:, : WIDTH // 3] = (255, 0, 255)
    Image.fromarray(pixels).save(first.image_path)
    plain = _views(masked_scene)[0].target(torch.zeros(3))
    view = _views(masked_scene, masks="masks", mask_meaning="transparent")[0]
    assert view.counted_pixels is None and view.alpha_mask.shape == (1, HEIGHT, WIDTH)
    target = view.target(torch.tensor([0.25, 0.5, 1.0]))
    assert (target[:, :, :32] == torch.tensor([0.25, 0.5, 1.0])[:, None, None]).all()
    assert torch.equal(view.target(torch.ones(3))[:, :, 32:], (plain / 255)[:, :, 32:])
    # Also at half the size: masked pixels do not bleed into the edge.
    half = _views(masked_scene, masks="masks", mask_meaning="transparent", resolution=48)[0]
    edge = (255 * torch.cat([half.original_image, half.alpha_mask])[:, :, 16]).round().int()
    assert (edge[3] > 200).all() and (edge[:3] - smooth[:, :, 16].int()).abs().float().mean() < 4


def test_alpha_is_background_unless_it_is_to_be_ignored(colmap_scene):
    name = read(colmap_scene).train_cameras[0].image_name
    pixels = np.asarray(Image.open(colmap_scene / "images" / name).convert("RGBA")).copy()
    pixels[:20, :, 3], pixels[20, :, 3] = 0, 128
    Image.fromarray(pixels).save(colmap_scene / "images" / name)
    for meaning in ("auto", "transparent"):
        view = _views(colmap_scene, mask_meaning=meaning)[0]
        assert view.counted_pixels is None and (view.target(torch.ones(3))[:, :20] == 1).all()
    view, other = _views(colmap_scene, mask_meaning="ignore")[:2]
    assert view.counted_pixels[:, 21:].all() and not view.counted_pixels[:, :21].any() and other.counted_pixels is None
    assert torch.equal(view.target(torch.ones(3)), torch.from_numpy(pixels[..., :3].transpose(2, 0, 1).copy()))

    view = _views(colmap_scene, mask_meaning="none")[0]
    assert view.counts_all_pixels and view.target(torch.ones(3)).dtype == torch.uint8
    assert torch.equal(view.target(torch.ones(3)), torch.from_numpy(pixels[..., :3].transpose(2, 0, 1).copy()))
    _save(colmap_scene / "masks" / name, np.repeat(np.uint8([[0, 255]]), 48, 1).repeat(HEIGHT, 0))
    view = _views(colmap_scene, masks="masks", mask_meaning="ignore")[0]
    assert view.counted_pixels[:, 21:, 48:].all() and view.counted_pixels.sum() == 43 * 48
    view = _views(colmap_scene, masks="masks", mask_meaning="transparent")[0]
    assert (view.alpha_mask[:, 21:, 48:] == 1).all() and (view.alpha_mask > 0).sum() == 44 * 48


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda masks: masks.rename(masks.parent / "elsewhere"), "no folder .*/masks for --masks; name a folder"),
        (
            lambda masks: [path.rename(path.parent / f"mask_{path.name}") for path in masks.rglob("*.*")],
            "no mask in .*/masks .* belongs to a photo: looked for .*V03.png.png .* name masks like the photos",
        ),
        (
            lambda masks: [_save(path, np.zeros((9, 9), np.uint8)) for path in masks.rglob("*.*")],
            "the mask .* is 9 x 9 pixels and its photo 96 x 64; make masks of the same shape",
        ),
        (lambda masks: [path.write_bytes(b"x") for path in masks.rglob("*.*")], "cannot read .*/masks/"),
    ],
)
def test_bad_masks_get_one_sentence(masked_scene, change, said):
    change(masked_scene / "masks")
    with pytest.raises(UserError, match=said):
        _views(masked_scene, masks="masks")
    with pytest.raises(UserError, match="--invert_masks has no masks to invert"):
        _views(masked_scene, invert_masks=True)
    with pytest.raises(UserError, match="--mask_meaning ignore has nothing to ignore: no masks .* no photo"):
        _views(masked_scene, mask_meaning="ignore")


def _train(scene: Path, out: Path, *options: object) -> bytes:
    command = ["-s", scene, "-m", out, "--iterations", 40, "--test_iterations", -1, "--eval", "-r", 48, *options]
    train.main(list(map(str, command)))
    return (out / "point_cloud" / "iteration_40" / "point_cloud.ply").read_bytes()


def test_training_rendering_and_scores_ignore_what_is_masked(masked_scene, tmp_path, monkeypatch):
    masks = ("--masks", "masks", "--test_iterations", 40)
    plain, masked = _train(masked_scene, tmp_path / "plain"), _train(masked_scene, tmp_path / "masked", *masks)
    assert json.loads((tmp_path / "masked" / "model.json").read_text())["masks"] == "masks"
    assert "masks" not in json.loads((tmp_path / "plain" / "model.json").read_text())

    def run(module, *arguments: object) -> None:
        monkeypatch.setattr(sys, "argv", [f"{module.__name__}.py", *map(str, arguments)])
        monkeypatch.setenv("TORCH_HOME", "/dev/null")
        monkeypatch.setenv("https_proxy", "http://127.0.0.1:9")
        module.main()

    run(render, "-m", tmp_path / "masked", "--skip_train", "--quiet")
    run(metrics, "-m", tmp_path / "masked")
    folder = tmp_path / "masked" / "test" / "ours_40"
    assert [path.name for path in sorted((folder / "masks").iterdir())] == ["00000.png", "00001.png", "00002.png"]
    for name, score in json.loads((tmp_path / "masked" / "per_view.json").read_text())["ours_40"]["PSNR"].items():
        counts, shown, truth = (np.asarray(Image.open(folder / d / name)) for d in ("masks", "renders", "gt"))
        assert counts.shape == (32, 48) and (counts[:, 18:] == 255).all() and not counts[:, :18].any()
        error = (shown[:, 18:].astype(float) - truth[:, 18:]) ** 2
        assert score == pytest.approx(10 * np.log10(255**2 / error.mean()), abs=1e-9)
    info = json.loads((tmp_path / "masked" / "metrics_info.json").read_text())
    assert info["masked_views"] == {"ours_40": 3} and "mean over the pixels that count" in info["masked"]["PSNR"]

    # Other pixels behind the masks give the same model to the byte.
    for path in (masked_scene / "images").rglob("*.png"):
        pixels = np.asarray(Image.open(path)).copy()
        pixels[:, : WIDTH // 3] = 255 - pixels[:, : WIDTH // 3]
        Image.fromarray(pixels).save(path)
    assert _train(masked_scene, tmp_path / "masked_again", *masks, "--images_to_load", 3) == masked != plain

    # Rendering without masks leaves the others alone, and removes earlier ones of its own.
    (without := folder.with_name("ours_40_masks_none") / "masks").mkdir(parents=True)
    (without / "00000.png").touch()
    run(render, "-m", tmp_path / "masked", "--skip_train", "--quiet", "--masks", "")
    assert list(without.iterdir()) == [] and len(list((folder / "masks").iterdir())) == 3

    # A view that is masked whole has no score.
    name = read(masked_scene).train_cameras[0].image_name
    _save(next((masked_scene / "masks").glob(f"{name}*")), np.zeros((HEIGHT, WIDTH), np.uint8))
    _train(masked_scene, tmp_path / "out", *masks)
    scores = json.loads((tmp_path / "out" / "train_log.json").read_text())[-1]
    assert 5 < scores["test_psnr"] < 40 and scores["test_l1"] > 0.01


def test_masks_that_leave_nothing_do_not_train_silently(masked_scene, tmp_path, capsys):
    paths = [path for path in sorted(masked_scene.rglob("masks/**/*")) if path.is_file()]
    for path in paths:
        _save(path, np.zeros((HEIGHT, WIDTH), np.uint8))
    with pytest.raises(UserError, match="16 of the 16 photos .* show nothing, as every pixel is left out by masks; "):
        _train(masked_scene, tmp_path / "out", "--masks", "masks")
    assert not (tmp_path / "out" / "point_cloud").exists()
    assert _train(masked_scene, tmp_path / "out", "--masks", "masks", "--invert_masks")
    assert "show nothing" not in capsys.readouterr().err


def test_views_that_count_are_looked_at_once(capsys):
    def view(uid: int, counting: int | None, columns: slice | None = None) -> SimpleNamespace:
        mask = None
        if counting is not None:
            mask = torch.zeros(1, 100, 100, dtype=torch.bool)
            mask.view(-1)[:counting] = True
        return SimpleNamespace(uid=uid, image_name=f"v{uid}", counted_pixels=mask, columns=columns)

    # 9 of 10000 pixels are too few, and the first 50 of a row are not in its right half.
    views = [view(0, 9), view(1, 10), view(2, None), view(3, 50, slice(50, 100))]
    watch = MaskWatch(views)
    for one in (*views[:3], views[0], views[3]):
        assert capsys.readouterr().err == ""
        watch.add(one, one.counted_pixels)
        watch.check(last=False)
    watch.check(last=True)
    said = capsys.readouterr().err
    assert said.count("warning") == 1 and "2 of 4 views" in said and "(v0, v3)" in said

    # Some of thousands of views may have no pixel; a hundred such views are a mistake.
    views = [view(uid, 0) for uid in range(150)]
    watch = MaskWatch(views)
    for one in views[:100]:
        watch.check(last=False)
        watch.add(one, one.counted_pixels)
    with pytest.raises(UserError, match="all 100 views"):
        watch.check(last=False)


def test_scores_are_those_of_the_definition():
    rng = np.random.default_rng(0)
    truth = rng.integers(0, 256, (40, 56, 3), dtype=np.uint8)
    shown = np.clip(truth + rng.normal(scale=20, size=truth.shape), 0, 255).astype(np.uint8)
    mask = np.ones((40, 56), bool)
    mask[5:30, 10:40] = False
    first = [torch.from_numpy((image * mask[..., None]).transpose(2, 0, 1) / 255.0) for image in (shown, truth)]
    expected = 1 - (1 - ssim_map(*first)).sum().item() / (3 * mask.sum())
    assert metrics.ssim(shown, truth, mask) == pytest.approx(expected, abs=1e-12)
    assert metrics.ssim(shown, truth, np.ones_like(mask)) == pytest.approx(metrics.ssim(shown, truth), abs=1e-12)
    hidden = np.where(mask[..., None], shown, 255 - shown)
    for metric in (metrics.ssim, metrics.psnr):
        assert metric(hidden, truth, mask) == metric(shown, truth, mask) != metric(shown, truth)


@pytest.mark.parametrize(
    ("mask", "fits"), [((134, 240), True), ((135, 240), True), ((240, 134), False), ((134, 200), False)]
)
def test_a_smaller_mask_may_have_rounded_sides(tmp_path, mask, fits):
    _save(tmp_path / "mask.png", np.full(mask[::-1], 255, np.uint8))
    with nullcontext() if fits else pytest.raises(UserError, match="make masks of the same shape"):
        _check_mask(tmp_path / "mask.png", (269, 480))
