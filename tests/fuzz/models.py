"""Cases of trained models: PLY files, exports, checkpoints."""

import gzip
import random
from pathlib import Path

import torch
from gaussians import model, options, take_steps
from rasterizer_tools import render
from small_splats import empty_spz, splats

from applications.export.formats import find_format
from fuzz.damage import changed, damaged, damaged_text
from scene.gaussian_model import GaussianModel
from scene.gaussians.checkpoint import load_checkpoint, save_checkpoint
from scene.splats.reading import read_splats
from tests.workloads.splat_scenes import settings

_TENSORS = (
    *(torch.zeros(0), torch.zeros(5), torch.zeros(5, 3, dtype=torch.float64), torch.zeros(5, 1, 3), torch.tensor(3.0)),
    *(torch.full((5, 3), float("nan")), torch.zeros(5, 3).to_sparse(), torch.zeros(1).expand(1 << 40)),
    *(torch.zeros(5, 3, device="meta"), torch.zeros(5, 3, dtype=torch.complex64), torch.full((5, 3), 1e30)),
    *(None, 0, -1, 2**40, "x", {}, [], float("nan")),
)


class Ply:
    """The PLY of a model is damaged; what can still be read must be renderable."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / "gaussians.ply"
        model(7, 1).save_ply(self._path)
        self._whole = self._path.read_bytes()
        self._header = self._whole.index(b"end_header\n")

    def run(self, rng: random.Random) -> None:
        head, body = self._whole[: self._header], self._whole[self._header :]
        if rng.random() < 0.5:
            self._path.write_bytes(damaged_text(rng, head.decode()).encode() + body)
        else:
            self._path.write_bytes(damaged(rng, self._whole))
        gaussians = GaussianModel(1)
        gaussians.load_ply(self._path)
        counts = {len(gaussians), *(len(rows) for rows in gaussians.rows().values())}
        assert len(counts) == 1, "attributes differ in length"
        _render(gaussians)


class Splats:
    """An export is damaged, or a few bytes that promise and pack very many splats."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._whole = folder, []
        for ending in (".compressed.ply", ".splat", ".spz"):
            path = folder / f"whole{ending}"
            find_format(path).write(path, splats(20, 1))
            self._whole.append((ending, path.read_bytes()))
        self._whole += [(".spz", empty_spz(version, 12_000_000)) for version in (3, 4)]
        unpacked = gzip.decompress(empty_spz(3, 20, 1))
        self._whole.append((".spz", gzip.compress(unpacked, 0)))  # whose header can be damaged

    def run(self, rng: random.Random) -> None:
        ending, whole = rng.choice(self._whole)
        head = min(len(whole), rng.choice((48, 2000, len(whole))))
        path = self._folder / f"damaged{ending}"
        path.write_bytes(damaged(rng, whole[:head]) + whole[head:])
        read = read_splats(path)
        assert len({len(read), *map(len, (read.log_scales, read.rotations, read.opacity_logits, read.sh))}) == 1


class Checkpoint:
    """A checkpoint is damaged, or has other content; what can still be read must be trainable."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / "damaged.pth"
        gaussians = model(5, 1)
        take_steps(gaussians, 2)
        save_checkpoint(self._path, gaussians.capture(), 12)
        self._whole = self._path.read_bytes()
        self._content = torch.load(self._path, weights_only=True)

    def run(self, rng: random.Random) -> None:
        if rng.random() < 0.5:
            self._path.write_bytes(damaged(rng, self._whole))
        else:
            torch.save(changed(rng, self._content, _TENSORS), self._path)
        capture, _ = load_checkpoint(self._path)
        gaussians = GaussianModel(1)
        gaussians.restore(capture, options())
        take_steps(gaussians, 1)
        finite = all(rows.isfinite().all() for rows in gaussians.rows().values())
        assert finite, "a step made values that are not finite"


def _render(gaussians: GaussianModel) -> None:
    if len(gaussians) > 1000:
        return
    parameters = {
        "means": gaussians.get_xyz, "sh_dc": gaussians.get_features_dc, "sh_rest": gaussians._features_rest,
        **gaussians.raw_geometry(),
    }  # fmt: skip
    with torch.no_grad():
        camera = settings(40, 30, torch.float32)._replace(sh_degree=1)
        image = render(parameters, camera).color
    assert image.isfinite().all(), "the image is not finite"
