"""The photometric loss by bands of an image: the bits of the whole image, from what a rank has of it."""

from collections.abc import Callable
from types import SimpleNamespace

import pytest
import torch
from fused_ssim import BAND_ROWS, REACH, fused_photometric_loss, photometric_loss_by_bands
from processes import in_ranks
from rasterizer_tools import BOTH_AND_GPU, GPU_MARKS
from torch import Tensor

from gaussian_renderer.over_ranks.band import exchange_halo, gather_image
from gaussian_renderer.over_ranks.bands import Bands, CachedBands, find_bands, processed_by_row, width_changes
from groundwork.ranks.ranks import Ranks, ranks

# Height, width, and the rows of tiles where bands begin and the last one ends.
CASES = [
    (70, 33, [0, 1, 1, 3, 5]),
    (97, 600, [0, 0, 4, 7]),  # a row has two parts whose sums are taken apart
    (33, 1, [0, 2, 3, 3]),  # the last band has one row
    (5, 130, [0, 0, 1]),
    pytest.param(960, 538, [0, 30, 60], marks=GPU_MARKS),  # a band by itself is small
    pytest.param(1060, 1600, [0, 20, 67], marks=GPU_MARKS),  # so large that blocks of the forward have 16 rows
]


def image_pair(height: int, width: int, dtype: torch.dtype, as_bytes: bool) -> tuple[Tensor, Tensor]:
    """A render with values outside [0, 1], and a photo."""
    generator = torch.Generator().manual_seed(height)
    image = 1.6 * torch.rand(3, height, width, generator=generator, dtype=dtype) - 0.3
    photo = torch.randint(256, (3, height, width), generator=generator, dtype=torch.uint8)
    return image, photo if as_bytes else photo.to(dtype) / 255


def _whole(image: Tensor, photo: Tensor, clamp: bool = True) -> tuple[Tensor, Tensor, Tensor]:
    image = image.clone().requires_grad_()
    loss, l1 = fused_photometric_loss(image, photo, 0.2, clamp)
    (0.7 * loss).backward()
    return loss.detach(), l1, image.grad


def check_bands(height: int, borders: list[int], images: tuple[Tensor, Tensor], clamp: bool = True) -> None:
    """Bands of an image, of which each knows 10 rows of the others, against the whole."""
    image, photo = images
    wanted, bands, sums = _whole(image, photo, clamp), Bands(borders, height, 0, image.device), []

    def losses(rank: int, add: Callable[[Tensor], Tensor]) -> tuple[Tensor, ...]:
        around = slice(*bands.pixels(rank, REACH))
        known, seen = torch.full_like(image, torch.nan), torch.zeros_like(photo)
        known[:, around], seen[:, around] = image[:, around], photo[:, around]
        known.requires_grad_()
        return *photometric_loss_by_bands(known, seen, 0.2, bands.pixels(rank), add, clamp), known

    def note(own: Tensor) -> Tensor:
        sums.append(own)
        return own

    for rank in range(len(borders) - 1):
        losses(rank, note)
    total = torch.stack(sums).sum(0)
    assert ((torch.stack(sums) != 0).sum(0) <= 1).all()
    for rank in range(len(borders) - 1):
        loss, l1, known = losses(rank, lambda own: total)
        (0.7 * loss).backward()
        assert torch.equal(loss, wanted[0]) and torch.equal(l1, wanted[1])
        own = slice(*bands.pixels(rank))
        assert torch.equal(known.grad[:, own], wanted[2][:, own])


@pytest.mark.parametrize("as_bytes", [True, False], ids=["bytes", "floats"])
@BOTH_AND_GPU
@pytest.mark.parametrize(("height", "width", "borders"), CASES)
def test_bands_have_the_loss_and_the_gradient_of_the_whole_image(height, width, borders, device, dtype, as_bytes):
    images = tuple(image.to(device) for image in image_pair(height, width, dtype, as_bytes))
    for clamp in (True, False):
        check_bands(height, borders, images, clamp)


@pytest.mark.parametrize("rows", [(8, 40), (16, 0), (0, 48), (-16, 16)])
def test_a_band_begins_and_ends_between_tiles(rows):
    with pytest.raises(ValueError, match=f"multiples of {BAND_ROWS} rows or with the image, got {rows[0]} and"):
        photometric_loss_by_bands(*image_pair(40, 20, torch.float32, True), 0.2, rows, torch.clone)


OF_THREE = [
    (70, [0, 1, 3, 5]),
    (33, [0, 0, 2, 3]),
    (40, [0, 2, 3, 3]),  # the last band but one has 8 rows, fewer than the loss reads
    (33, [0, 2, 3, 3]),  # or one
    (12, [0, 0, 0, 1]),
]


def _shared() -> list[tuple[Tensor, ...]]:
    here, found = ranks(), []
    for height, borders in OF_THREE:
        image, photo = image_pair(height, 20, torch.float32, True)
        bands = Bands(borders, height, here.rank, image.device)
        view = SimpleNamespace(ranks=here, bands=bands, color=torch.full_like(image, torch.nan))
        view.inverse_depth = torch.full_like(image[:1], torch.nan)
        first, end = bands.pixels(here.rank)
        view.color[:, first:end], view.inverse_depth[:, first:end] = image[:, first:end], photo[:1, first:end]
        color = exchange_halo(view).color.clone().requires_grad_()
        loss, l1 = photometric_loss_by_bands(color, photo, 0.2, (first, end), here.all_reduce_sum)
        (0.7 * loss).backward()
        gather_image(view)
        found.append((loss.detach(), l1, color.grad[:, first:end], view.color, view.inverse_depth))
    return found


def test_ranks_send_each_other_what_a_loss_needs():
    found = in_ranks(3, _shared)
    for case, (height, _) in enumerate(OF_THREE):
        image, photo = image_pair(height, 20, torch.float32, True)
        loss, l1, gradient = _whole(image, photo)
        of_case = [of_rank[case] for of_rank in found]
        assert torch.equal(torch.cat([each[2] for each in of_case], 1), gradient)
        for each in of_case:
            assert torch.equal(each[0], loss) and torch.equal(each[1], l1)
            assert torch.equal(each[3], image) and torch.equal(each[4], photo[:1].float())


class _Others(Ranks):
    """Ranks whose splats are all known here."""

    size = 3

    def __init__(self, rects: list[Tensor], height: int = 97) -> None:
        self._rects, self._height = rects, height

    def all_gather(self, values: Tensor) -> Tensor:
        others = [width_changes(rects, torch.ones(len(rects)), self._height) for rects in self._rects[1:]]
        widths = torch.stack((values[0], *others))
        return torch.stack((widths, values[1] * torch.tensor([[1], [0], [0]])), 1)


def test_bands_follow_what_an_earlier_visit_has_processed():
    rects = torch.tensor([[0, 0, 2, 60]], dtype=torch.int32)
    last = torch.zeros(953, 40, dtype=torch.int32)  # of 60 x 3 tiles, the last ones cut off
    last[70:100, 3] = 40_000  # in three rows of tiles
    last[75, 39] = 100
    processed = processed_by_row(last, range(4, 60))
    assert processed.nonzero().flatten().tolist() == [4, 5, 6] and processed[4:7].tolist() == [40_100, 40_000, 40_000]
    assert not processed_by_row(last, range(7, 60)).any() and not processed_by_row(last, range(6, 6)).any()
    ranks, counts = _Others([rects] * 3, height=953), torch.ones(1)
    assert find_bands(ranks, rects, counts, 953, 40).borders == [0, 20, 40, 60]
    assert find_bands(ranks, rects, counts, 953, 40, processed).borders == [0, 5, 6, 60]
    known = CachedBands()
    for visit in range(16):
        borders = known.find("a", ranks, rects, counts, 953, 40).borders
        known.note_processed("a", last)
        assert borders == ([0, 20, 40, 60] if visit < 8 else [0, 5, 6, 60])
