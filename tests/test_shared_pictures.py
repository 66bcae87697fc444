"""Pictures that ranks share: each decodes and keeps a part of them, and all train on the same bytes."""

import hashlib
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch
from parts.test_depth_maps import scene  # noqa: F401  (a fixture)
from PIL import Image
from processes import in_ranks
from trainings import PYRAMID

import train
from groundwork.ranks.ranks import ranks
from groundwork.ranks.shared_images import assign_holders
from scene.images.store import ImageStore
from splatting import resources
from utils.system_utils import UserError

LENGTH = (
    *("--iterations", 30, "--densify_from_iter", 5, "--densification_interval", 10, "--densify_grad_threshold", 5e-5),
    *("--disable_viewer", "--quiet", "--no_curve", "--test_iterations", 20, "-r", 96),
)
SMALLER = *PYRAMID, "--iterations", 60
TRAININGS = {
    "masks": ("--masks", "masks", "-d", "depths", "--eval"),
    "alpha": ("--masks", "masks", "--mask_meaning", "transparent", "--random_background"),
    "limit": ("--masks", "masks", "-d", "depths", "--images_to_load", 4),
    "smaller, limit": ("--masks", "masks", "-d", "depths", *SMALLER, "--images_to_load", 3),
    "exposures": ("--train_test_exp", "--eval"),
}


def _train(scene: Path, folder: Path, *options: object) -> tuple[str, Counter, str]:  # noqa: F811
    """Train: a digest of the model, how often each picture was decoded here, and the line on memory."""
    decoded, said, decode = Counter(), [], ImageStore._decode

    def counted(store: ImageStore, key: tuple) -> torch.Tensor:
        decoded[str(key)] += 1
        return decode(store, key)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ImageStore, "_decode", counted)
        patch.setattr(resources, "print", said.append, raising=False)
        patch.setattr(resources, "LITTLE", 0.0)  # the line is printed, however little that is
        train.main(["-s", str(scene), "-m", str(folder), *map(str, (*LENGTH, *options))])
    models = folder.glob("point_cloud/*/point_cloud.ply")
    return "".join(hashlib.sha256(path.read_bytes()).hexdigest() for path in models), decoded, said[0]


def _all(scene: Path, folder: Path) -> dict[str, tuple[str, Counter, str]]:  # noqa: F811
    torch.set_num_threads(1)
    folder = folder / str(ranks().size)
    return {name: _train(scene, folder / name, *options) for name, options in TRAININGS.items()}


def test_each_picture_is_decoded_by_one_rank_and_trains_all(scene, tmp_path):  # noqa: F811
    for path in (scene / "depths").rglob("*.png"):
        mask = scene / "masks" / path.relative_to(scene / "depths")
        mask.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.repeat(np.uint8([[0, 255, 255]]), 64, 0).repeat(32, 1)).save(mask)
    (one,), found = in_ranks(1, _all, scene, tmp_path), in_ranks(2, _all, scene, tmp_path)
    for name, (model, decoded, line) in one.items():
        assert "photos" in line and "each" not in line
        here = [rank[name] for rank in found]
        assert here[0][0] == model, name
        if "limit" not in name:
            assert sum((part for _, part, _ in here), Counter()) == decoded and set(decoded.values()) == {1}
            assert all(0.4 < part.total() / decoded.total() < 0.6 for _, part, _ in here), name
        elif name == "limit":
            assert "keeps 4 of 51 decoded" in line and re.search(r"keeps 4 of 2\d decoded .* each of 2 p", here[0][2])
    assert len({model for model, _, _ in one.values()}) == len(one)


def _stores(paths: list[Path], size: tuple[int, int]) -> tuple:
    """Return the plans and the pictures of a rank, with an error for the file that is no picture."""
    store = ImageStore(ranks=ranks())
    store.plan([(path, size) for path in paths[:4]], [(path, size) for path in paths])
    store.prefetch([(path, size) for path in paths])
    got = []
    for path in [*paths, *paths]:
        try:
            got.append(store.get(path, size).tolist())
        except UserError as error:
            got.append(str(error))
    changes = []
    small = store.transformed(paths[0], size, lambda pixels: changes.append(1) or pixels[:1, :1, :1].float() / 2)
    return store.planned_bytes, store.planned, len(store), got, [small.pixels.tolist() for _ in range(2)], len(changes)


def test_an_error_and_other_forms_reach_all_ranks(tmp_path):
    paths, size = [tmp_path / f"{number}.png" for number in range(5)], (3, 2)
    for number, path in enumerate(paths):
        Image.new("RGBA" if number % 2 else "RGB", size, (10 * number + 8, 0, 0, 128)[: 3 + number % 2]).save(path)
    paths[4].write_bytes(b"no picture")
    (one,), found = in_ranks(1, _stores, paths, size), in_ranks(3, _stores, paths, size)
    assert [rank[:2] for rank in found] == [(48, 2), (48, 2), (24, 1)] and one[:2] == (120, 5)
    assert sum(rank[2] for rank in found) == one[2] == 4
    for rank in found:
        assert rank[3:5] == one[3:5]
    assert str(paths[4]) in one[3][4] and one[3][1][0][0][0] == 18 and one[4] == [[[[4.0]]]] * 2
    assert [rank[5] for rank in found] == [1, 0, 0]


def test_the_rank_with_the_least_keeps_the_next():
    assert assign_holders([7] * 5, 3) == [0, 1, 2, 0, 1]
    assert assign_holders([30, 10, 30, 10, 30, 10], 2) == [0, 1, 1, 0, 0, 1]
