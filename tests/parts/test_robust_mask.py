"""Masks from residuals (--robust_mask): what they find, how much, and trainings with them."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from scipy import ndimage
from synthetic import make_colmap_scene
from trainings import trained

from splatting.features import robust_mask_residuals as residuals
from splatting.features.robust_mask_residuals import Residuals
from splatting.records.renders import GAP, HEADER
from splatting.records.training_log import read_log
from utils.system_utils import UserError

ON = "--robust_mask", 0.3, "--test_iterations", -1, "--opacity_reset_interval", 3000


def _views(count: int, width: int = 96, height: int = 64) -> list[SimpleNamespace]:
    return [SimpleNamespace(uid=k, image_name=f"{k}.png", image_width=width, image_height=height) for k in range(count)]


def _photo(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A photo of fine detail, uint8, and a render that is a blurred one."""
    detail = np.random.default_rng(seed).uniform(64, 192, (3, 64, 96))
    blurred = ndimage.uniform_filter(detail, (0, 5, 5))
    return torch.from_numpy(detail).to(torch.uint8), torch.from_numpy(blurred / 255).float()


def _visit(masks: Residuals, views: list, photos: list, times: int) -> list[torch.Tensor | None]:
    found = []
    for _ in range(times):
        found = []
        for view, (photo, image) in zip(views, photos, strict=True):
            found.append(masks.mask(view, image, photo, None, learns=True))
            masks.keep()
    return found


def test_a_passer_by_is_masked_and_detail_is_not(monkeypatch):
    """Detail has large residuals, too, pixel by pixel; only their means over cells are small."""
    monkeypatch.setattr(Residuals, "early", 3)  # the edge does not reach so high a limit
    views, photos = _views(10), [_photo(seed) for seed in range(10)]
    there = np.hypot(*(np.mgrid[:64, :96] - np.array([30, 40])[:, None, None])) < 12
    photos[3][0][:, there] = 20
    masks = Residuals(views, 0.3, torch.device("cpu"))
    assert _visit(masks, views, photos, Residuals.least) == [None] * 10
    found = _visit(masks, views, photos, 1)
    assert [mask is not None for mask in found] == [k == 3 for k in range(10)]
    assert residuals.odd_share(masks) == 0.1
    masked = ~found[3][0].numpy()
    assert masked[there].all() and not masked[~ndimage.binary_dilation(there, iterations=6)].any()
    assert masks.mask(views[3], photos[3][1], photos[3][0], None, learns=False) is not None
    assert _visit(masks, views, photos, residuals._UNMASKED - 3) == [None] * 10  # or a floater would stay, too
    now = [masks.counted(view) for view in views]
    assert not now.pop(3)[~found[3]].any() and now == [None] * 9 and masks.counted(_views(1)[0]) is None


@pytest.mark.parametrize("share", [0.05, 0.3])
def test_no_more_is_masked_than_the_share(share):
    views, photos = _views(10), [_photo(seed) for seed in range(10)]
    photos[3][0][:] = 255
    photos[4][0][:, :, :60] = 0
    masks = Residuals(views, share, torch.device("cpu"))
    found = _visit(masks, views, photos, Residuals.least + 1)
    assert all(0 < (~found[k]).float().mean() <= share + 0.05 for k in (3, 4))  # cells of a pixel more or less


def test_masks_of_files_stay_and_resets_teach_nothing():
    views, photos = _views(3), [_photo(seed) for seed in range(3)]
    masks = Residuals(views, 0.3, torch.device("cpu"))
    _visit(masks, views, photos, Residuals.least)
    before = masks.captured()
    given = torch.ones(1, 64, 96, dtype=torch.bool)
    given[:, :20] = False
    photo, image = photos[0]
    assert masks.mask(views[0], torch.zeros_like(image), photo, given, learns=False) is given
    masks.keep()
    assert all(torch.equal(before[name], masks.captured()[name]) for name in ("residuals", "levels", "visits"))
    photo = photo.clone()
    photo[:, :20] = 0  # where nothing counts
    assert masks.mask(views[0], image, photo, given, learns=True) is given


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With a white square in three photos."""
    folder = tmp_path_factory.mktemp("robust") / "scene"
    make_colmap_scene(folder)
    for path in sorted(path for path in (folder / "images").rglob("*") if path.is_file())[1:4]:
        pixels = np.array(Image.open(path).convert("RGB"))
        pixels[20:44, 30:60] = 255 - pixels[20:44, 30:60].mean((0, 1)).round().astype(np.uint8)
        Image.fromarray(pixels).save(path)
    return folder


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """In trainings of 60 iterations, whose renders are far from the photos."""
    monkeypatch.setattr(Residuals, "early", 0)


def test_a_training_shows_what_it_leaves_out(scene, tmp_path, monkeypatch):
    whole = trained(scene, tmp_path / "whole", *ON)
    assert (off := trained(scene, tmp_path / "off", *ON[2:]))["ply"] != whole["ply"]
    lines = read_log(tmp_path / "whole" / "train_log.json")[-1]["lines"]
    (said,) = [line for line in lines if line.startswith("--robust_mask leaves out")]
    files = [path for path in (tmp_path / "whole" / residuals.FOLDER).rglob("*.png")]
    assert f"in {len(files)} of 14 photos" in said and files
    with Image.open(tmp_path / "whole" / residuals.MASK_PICTURE) as picture:
        pixels = np.asarray(picture, int)
    wide = (picture.width - 3 * GAP) // 2
    left, right = pixels[HEADER:, GAP : GAP + wide], pixels[HEADER:, -GAP - wide : -GAP]
    assert 0.01 < (right < left - 20).any(2).mean() < 0.4  # the same photos, darker where pixels are left out
    again = trained(scene, tmp_path / "again", "--masks", tmp_path / "whole" / residuals.FOLDER, *ON[2:])
    assert again["ply"] != off["ply"]  # they are mask files


@pytest.mark.parametrize("above", ["../", "{}/images/"])
def test_masks_are_written_below_the_model_folder(tmp_path, above, monkeypatch):
    """Wherever the dataset says that its photos are."""
    names = [above.format(tmp_path) + f"{side}/1.png" for side in ("left", "right")]
    cameras = [SimpleNamespace(image_name=name) for name in names]
    masks = SimpleNamespace(cameras=cameras, counted=lambda camera: torch.ones(1, 4, 4))
    model = tmp_path / "model" / "of" / "it"
    monkeypatch.setattr(residuals, "_draw", lambda *_: None)
    residuals.write_masks(masks, model, str(tmp_path / "scene"), torch.zeros(3))
    found = [path.relative_to(model).as_posix() for path in tmp_path.rglob("*.png")]
    assert sorted(found) == ["robust_masks/left/1.png.png", "robust_masks/right/1.png.png"]


def test_residuals_of_other_photos_are_refused():
    masks, others = (Residuals(_views(n), 0.3, torch.device("cpu")) for n in (3, 4))
    with pytest.raises(UserError, match="residuals of other photos"):
        masks.restore(others.captured())
