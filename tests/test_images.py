"""Photos to images: sizes, modes, resizing against Pillow, broken files, the bounded store."""

import io

import numpy as np
import pytest
import torch
from PIL import Image

from scene.images import sizes as resolution
from scene.images.decode import decode, picture_size
from scene.images.sizes import training_size
from utils.system_utils import UserError


@pytest.mark.parametrize(
    ("file", "r", "scale", "size"),
    [
        ((1601, 901), 1, 1, (1601, 901)),
        ((1601, 901), 2, 1, (800, 450)),  # 800.5 and 450.5 round to even
        ((1603, 903), 2, 1, (802, 452)),  # 801.5 and 451.5 as well
        ((1601, 901), 4, 1, (400, 225)),
        ((1601, 901), 8, 1, (200, 113)),
        ((1602, 901), -1, 1, (1600, 899)),  # 899.9 is cut off
        ((1601, 901), -1, 1, (1599, 900)),  # the reference's division: 1601 / (1601 / 1600) is just below 1600
        ((1600, 901), -1, 1, (1600, 901)),
        ((900, 4000), -1, 1, (900, 4000)),  # only the width counts
        ((1601, 901), 1000, 1, (1000, 562)),  # 562.8 is cut off
        ((500, 333), 1000, 1, (1000, 666)),  # a width can enlarge
        ((501, 333), 3, 1, (3, 1)),
        ((3, 3), 8, 1, (1, 1)),  # never without pixels
        ((1601, 901), 2, 2.0, (400, 225)),
        ((1000, 500), -1, 2.0, (500, 250)),
        ((1000, 500), 400, 2.0, (200, 100)),
    ],
)
def test_training_size(file, r, scale, size):
    assert training_size(*file, r, scale) == size


@pytest.mark.parametrize("r", [16385, 100_000_000, 10**400], ids=["next", "huge", "beyond float"])
def test_absurd_widths_are_refused(r):
    with pytest.raises(UserError, match=r"-r\) 1\d+ is too wide; give at most 16384"):
        training_size(48, 32, r)


def test_absurd_heights_are_refused():
    assert training_size(10, 20, 8192) == (8192, 16384)
    with pytest.raises(UserError, match=r"10 x 30 pixels would train at 8192 x 24576 with --resolution \(-r\) 8192"):
        training_size(10, 30, 8192)
    with pytest.raises(UserError, match="would train at 100 x 20000"):
        training_size(100, 20_000, -1)


def test_too_little_memory_names_the_picture_and_its_size(tmp_path, monkeypatch):
    def full(*_):
        raise MemoryError

    Image.fromarray(_noise((4, 6, 3))).save(tmp_path / "a.png")
    monkeypatch.setattr(Image.Image, "resize", full)
    with pytest.raises(UserError, match="memory for .*a.png at 12 x 8 pixels"):
        decode(tmp_path / "a.png", (12, 8))


def test_the_notice_comes_once(capsys):
    resolution._notice.cache_clear()
    training_size(1600, 10, -1)
    assert capsys.readouterr().err == ""
    for _ in range(3):
        training_size(1601, 10, -1)
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "1600" in said and "-r 1" in said


def _noise(shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def _chw(image: Image.Image) -> torch.Tensor:
    return torch.from_numpy(np.array(image)).permute(2, 0, 1)


def test_resizing_is_pillows_bicubic(tmp_path):
    image = Image.fromarray(_noise((31, 47, 3)))
    image.save(tmp_path / "a.png")
    assert torch.equal(decode(tmp_path / "a.png", (47, 31)), _chw(image))
    assert torch.equal(decode(tmp_path / "a.png", (20, 13)), _chw(image.resize((20, 13))))


def test_alpha_is_copied_at_full_size_and_weighs_colours_when_shrunk(tmp_path):
    pixels = _noise((32, 32, 4))
    pixels[:16, :, :3] = 255  # white behind zero alpha must not bleed into the neighbours
    pixels[:16, :, 3] = 0
    pixels[16:, :, :3] = 40
    pixels[16:, :, 3] = 255
    Image.fromarray(pixels).save(tmp_path / "a.png")
    assert torch.equal(decode(tmp_path / "a.png", (32, 32)), _chw(Image.fromarray(pixels)))
    small = decode(tmp_path / "a.png", (8, 8)).float()
    premultiplied = torch.from_numpy(pixels[..., :3] * (pixels[..., 3:] / 255.0)).permute(2, 0, 1)
    separate = Image.Resampling.BICUBIC
    wanted = np.stack(
        [np.array(Image.fromarray(c.astype(np.float32)).resize((8, 8), separate)) for c in premultiplied.numpy()]
    )
    alpha = np.array(Image.fromarray(pixels[..., 3].astype(np.float32)).resize((8, 8), separate)).clip(0, 255)
    seen = alpha > 20  # colours of nearly transparent pixels are rounded coarsely
    difference = np.abs(small[:3].numpy() - wanted / np.maximum(alpha, 1) * 255)[:, seen]
    assert seen.any() and difference.max() <= 255 / 20  # half a step of the premultiplied colour, divided by alpha
    assert np.abs(small[3].numpy() - alpha).max() <= 1


def test_an_alpha_that_hides_nothing_is_dropped(tmp_path):
    pixels = _noise((8, 8, 4))
    pixels[..., 3] = 255
    Image.fromarray(pixels).save(tmp_path / "a.png")
    assert decode(tmp_path / "a.png", (8, 8)).shape == (3, 8, 8)


def test_grey_palette_cmyk_and_16_bit_become_rgb(tmp_path):
    grey = _noise((6, 5))
    Image.fromarray(grey).save(tmp_path / "l.png")
    Image.fromarray(grey.astype(np.uint16) * 257).save(tmp_path / "deep.png")
    for name in ("l.png", "deep.png"):
        assert torch.equal(decode(tmp_path / name, (5, 6)), torch.from_numpy(grey).expand(3, 6, 5)), name

    rgb = Image.fromarray(_noise((6, 5, 3)))
    palette = rgb.quantize(16)
    palette.save(tmp_path / "p.png")
    assert torch.equal(decode(tmp_path / "p.png", (5, 6)), _chw(palette.convert("RGB")))
    palette.save(tmp_path / "clear.png", transparency=0)
    assert decode(tmp_path / "clear.png", (5, 6)).shape == (4, 6, 5)
    rgb.convert("CMYK").save(tmp_path / "c.tif")
    assert torch.equal(decode(tmp_path / "c.tif", (5, 6)), _chw(rgb.convert("CMYK").convert("RGB")))
    Image.fromarray(np.dstack([grey, grey])).save(tmp_path / "la.png")
    assert torch.equal(decode(tmp_path / "la.png", (5, 6))[3], torch.from_numpy(grey))


def test_exif_orientation_is_ignored(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    image = Image.fromarray(_noise((10, 20, 3)))
    image.save(tmp_path / "a.png", exif=exif)
    assert picture_size(tmp_path / "a.png") == (20, 10)
    assert torch.equal(decode(tmp_path / "a.png", (20, 10)), _chw(image))


@pytest.mark.parametrize("suffix", ["png", "jpg"])
@pytest.mark.parametrize("kept", [0.0, 0.3, 0.9])
def test_a_truncated_picture_is_found_before_it_is_needed(tmp_path, suffix, kept):
    buffer = io.BytesIO()
    Image.fromarray(_noise((64, 64, 3))).save(buffer, "PNG" if suffix == "png" else "JPEG")
    whole = buffer.getvalue()
    path = tmp_path / f"cut.{suffix}"
    path.write_bytes(whole)
    assert picture_size(path) == (64, 64)
    path.write_bytes(whole[: int(len(whole) * kept)])
    for use in (picture_size, lambda path: decode(path, (64, 64))):
        with pytest.raises(UserError, match=f"cut.{suffix}"):
            use(path)


def test_a_whole_picture_with_bytes_behind_it_is_accepted(tmp_path):
    path = tmp_path / "long.jpg"
    Image.fromarray(_noise((64, 64, 3))).save(path)
    path.write_bytes(path.read_bytes() + b"\0" * 10_000)
    assert picture_size(path) == (64, 64)
