"""Gradient rows as processes exchange them: of bands of an image, put together by splat, they give the same bits."""

from dataclasses import dataclass
from typing import NamedTuple

import pytest
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings
from diff_gaussian_rasterization.scene import GRADIENTS, Drawing, Scene, draw
from rasterizer_tools import BOTH_AND_GPU, CPU_AND_GPU, moved_by_a_word, ops, scene_arguments
from torch import Tensor

from tests.workloads.splat_scenes import PARAMETERS, frustum, move_camera, settings

WIDTH, HEIGHT = 45, 70  # 3 x 5 tiles, some cut off
ACROSS, DOWN = 3, 5
WANTED = [name in (*PARAMETERS, "means2d") for name in GRADIENTS]


class Rows(NamedTuple):
    """The results of `blend_rows`."""

    rows: Tensor
    counts: Tensor


@dataclass
class Forward:
    """A scene projected, binned and blended by single operators, and a gradient of its planes."""

    scene: Scene
    projected: tuple[Tensor, ...]  # splats, depths, rects, tile_counts, radii
    lists: tuple[Tensor, ...]  # instances, ranges, splat_slots, slots
    background: Tensor
    planes: list[Tensor]  # gradients; None where not wanted
    blended: tuple[Tensor, ...]  # color, transmittance, inverse_depth, last, layers
    depth: bool

    @classmethod
    def of(
        cls, raw: dict[str, Tensor], camera: GaussianRasterizationSettings, depth: bool, activated: bool = False
    ) -> "Forward":
        scene = scene_arguments(raw, camera, not activated)
        projected, size = ops.project(*scene), scene.size
        lists = ops.bin(*projected[:4], *size, True)
        blended = ops.blend(projected[0], *lists[:2], camera.bg, *size, depth, True)
        generator = torch.Generator().manual_seed(2)
        planes = [torch.randn(t.shape, generator=generator).to(t) for t in blended[:3]]
        return cls(scene, projected, lists, camera.bg, planes if depth else [planes[0], None, None], blended, depth)

    def blend_band(self, top: int, bottom: int) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        """Blend tile rows `top` to `bottom` only, whose lists stay; return these lists and the planes."""
        instances, ranges, *slots = self.lists
        ranges = ranges.clamp(ranges[top * ACROSS], ranges[bottom * ACROSS])
        size = self.blended[1].shape[1:]
        blended = ops.blend(self.projected[0], instances, ranges, self.background, *size, self.depth, True)
        return (instances, ranges, *slots), blended

    def kept(self, lists: tuple[Tensor, ...], blended: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """Return the tensors that a forward keeps for its backward."""
        splats, _, _, tile_counts, radii = self.projected
        *planes, last, layers = blended
        return Drawing(*planes, radii, splats, tile_counts, *lists, last, layers).kept(self.background)

    def rows(self, absolute: bool) -> Rows:
        return Rows(*ops.blend_rows(self.kept(self.lists, self.blended), *self.planes, absolute))

    def rows_of_bands(self, cuts: list[int], absolute: bool) -> Rows:
        """The rows of the bands between cuts, each splat's in the order of the bands."""
        bands = []
        for top, bottom in zip(cuts, cuts[1:], strict=False):
            bands.append(Rows(*ops.blend_rows(self.kept(*self.blend_band(top, bottom)), *self.planes, absolute)))
        splats = torch.arange(len(self.projected[0]), device=self.background.device)
        owners = torch.cat([torch.repeat_interleave(splats, band.counts) for band in bands])
        rows = torch.cat([band.rows for band in bands])[torch.argsort(owners, stable=True)]
        return Rows(rows, torch.stack([band.counts for band in bands]).sum(0, dtype=torch.int32))

    def source(self, rows: Rows) -> tuple[Tensor, ...]:
        return self.projected[0], self.projected[3], *rows

    def rows_vjp(self, rows: Rows, absolute: bool, wanted: list[bool] = WANTED) -> tuple[Tensor, ...]:
        return ops.rasterize_vjp(*self.scene, wanted, self.source(rows), absolute=absolute)

    def lists_vjp(self, absolute: bool, wanted: list[bool] = WANTED) -> tuple[Tensor, ...]:
        return ops.rasterize_vjp(*self.scene, wanted, self.kept(self.lists, self.blended), *self.planes, absolute)


def same_bits(one: Tensor, other: Tensor) -> bool:
    bits = [t.cpu().contiguous().numpy().tobytes() for t in (one, other)]
    return one.shape == other.shape and one.dtype == other.dtype and bits[0] == bits[1]


def scene_of(kind: str, device: str, dtype: torch.dtype) -> tuple[dict[str, Tensor], GaussianRasterizationSettings]:
    """Raw parameters and a camera of WIDTH x HEIGHT."""
    scene = frustum({"empty": 0, "one": 1}.get(kind, 300), WIDTH, HEIGHT, 4.0, seed=3)
    raw = {name: scene.parameters[name].clone() for name in PARAMETERS}
    raw["means"] *= torch.tensor([1.6, 1.6, 1.0])  # some are not seen
    if kind == "behind":
        raw["means"][:, 2] *= -1
    elif kind == "giants":  # two over the whole image, and culled ones among others
        raw["means"][[40, 200]], raw["scales"][[40, 200]] = torch.tensor([0.0, 0.0, 3.0]), 1.5
        raw["opacities"][[40, 200]] = -2.0
        raw["opacities"][::7] = torch.nan
    camera = settings(WIDTH, HEIGHT, dtype, projection="ray" if kind == "rays" else "ewa")
    return {name: t.to(device, dtype).contiguous() for name, t in raw.items()}, move_camera(camera, device)


SCENES = pytest.mark.parametrize("kind", ["empty", "one", "behind", "giants", "many", "rays"])
BOTH = pytest.mark.parametrize(("depth", "absolute"), [(False, True), (True, False)])


@BOTH_AND_GPU
@SCENES
@pytest.mark.parametrize("depth", [False, True])
def test_single_steps_of_the_forward_are_rasterize_to_the_bit_and_bands_have_its_pixels(kind, depth, device, dtype):
    raw, camera = scene_of(kind, device, dtype)
    forward = Forward.of(raw, camera, depth)
    for top, bottom in ((0, 1), (1, 4), (4, 5), (2, 2)):
        _, blended = forward.blend_band(top, bottom)
        for got, whole in zip(blended[:4], forward.blended[:4], strict=True):
            assert same_bits(got[..., 16 * top : 16 * bottom, :], whole[..., 16 * top : 16 * bottom, :])
    out = draw(forward.scene, camera.bg, depth)
    color, transmittance, inverse_depth, radii, splats, tile_counts, *lists, last, layers = out
    seen = tile_counts > 0  # the other rows are undefined
    assert (kind in ("empty", "behind")) == (not seen.any())
    assert same_bits(splats[seen], forward.projected[0][seen])
    assert same_bits(tile_counts, forward.projected[3]) and same_bits(radii, forward.projected[4])
    assert all(same_bits(a, b) for a, b in zip(lists[:2], forward.lists[:2], strict=True))
    assert same_bits(lists[2][:, 0], forward.lists[2][:, 0])
    planes = color, transmittance, inverse_depth, last
    assert all(same_bits(a, b) for a, b in zip(planes, forward.blended[:4], strict=True))
    assert layers.shape == forward.blended[4].shape and (layers.numel() > 0) == (device == "cuda")


@BOTH_AND_GPU
@SCENES
@BOTH
def test_rows_give_the_gradients_of_the_lists_and_bands_the_rows_of_the_image(kind, depth, absolute, device, dtype):
    forward = Forward.of(*scene_of(kind, device, dtype), depth)
    rows = forward.rows(absolute)
    for cuts in ([0, 1, 2, 3, 4, 5], [0, 2, 5], [0, 0, 4, 5, 5]):
        bands = forward.rows_of_bands(cuts, absolute)
        assert same_bits(bands.rows, rows.rows) and same_bits(bands.counts, rows.counts)
    values = (14 if kind == "rays" else 10) + 2 * absolute
    assert rows.rows.shape == (int(rows.counts.sum()), values) and rows.counts.dtype == torch.int32
    assert not rows.counts[forward.projected[3] == 0].any()
    for wanted in ([False] * 2 + WANTED[2:], WANTED):
        got, expected = forward.rows_vjp(rows, absolute, wanted), forward.lists_vjp(absolute, wanted)
        assert all(same_bits(a, b) for a, b in zip(got, expected, strict=True))
    if kind == "giants":
        assert rows.counts[40] == ACROSS * DOWN and got[1].count_nonzero() > 100
        assert (got[0][40, 2] > 0) == absolute


@CPU_AND_GPU
def test_inputs_may_begin_at_any_word(device):
    forward = Forward.of(*scene_of("many", device, torch.float32), depth=True)
    rows = forward.rows(False)
    gradients, by_lists = forward.rows_vjp(rows, False), forward.lists_vjp(False)
    forward.projected = tuple(map(moved_by_a_word, forward.projected))
    lists = ops.bin(*forward.projected[:4], HEIGHT, WIDTH, True)
    assert all(same_bits(a, b) for a, b in zip(lists[:2], forward.lists[:2], strict=True))
    planes = zip(forward.blend_band(0, DOWN)[1][:4], forward.blended[:4], strict=True)  # layers are undefined in part
    assert all(same_bits(a, b) for a, b in planes)
    forward.blended = (*forward.blended[:4], moved_by_a_word(forward.blended[4]))
    assert same_bits(forward.rows(False).rows, rows.rows)
    again = forward.rows_vjp(Rows(moved_by_a_word(rows.rows), rows.counts), False)
    assert all(same_bits(a, b) for a, b in zip(again, gradients, strict=True))
    assert all(same_bits(a, b) for a, b in zip(forward.lists_vjp(False), by_lists, strict=True))
