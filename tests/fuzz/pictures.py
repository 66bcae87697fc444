"""Cases of photos: files of all formats, damaged, and masks."""

import io
import random
from pathlib import Path

import numpy as np
from PIL import Image

from fuzz.damage import damaged
from scene.images.decode import decode, may_be_transparent, picture_size
from scene.images.masks import Mask
from scene.images.sizes import training_size
from scene.readers.depth_maps import read_values

_SAVED = (
    *(("PNG", mode, {}) for mode in ("RGB", "RGBA", "L", "1", "I;16", "P", "LA")),
    *(("JPEG", mode, {}) for mode in ("RGB", "L", "CMYK")),
    ("JPEG", "RGB", {"progressive": True}),
    *(("TIFF", mode, {}) for mode in ("RGB", "I;16", "F", "CMYK")),
    *(("TIFF", "RGB", {"compression": how}) for how in ("tiff_lzw", "tiff_deflate", "jpeg")),
    *(("BMP", "RGB", {}), ("BMP", "P", {}), ("WEBP", "RGB", {}), ("WEBP", "RGBA", {"lossless": True})),
    *(("GIF", "P", {}), ("PPM", "RGB", {}), ("JPEG2000", "RGB", {}), ("TGA", "RGB", {}), ("EPS", "RGB", {})),
    *(("ICO", "RGBA", {}), ("PCX", "RGB", {}), ("SGI", "RGB", {})),
)


class Picture:
    """A picture of any format is damaged, mostly near its start, where sizes are."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / "picture.png"
        pixels = np.random.default_rng(0).integers(0, 256, (24, 32, 4)).astype(np.uint8)
        self._whole = []
        for kind, mode, how in _SAVED:
            image = Image.fromarray(pixels)
            if mode == "I;16":
                image = Image.fromarray(pixels[..., 0].astype(np.uint16) * 257)
            elif mode != "RGBA":
                image = (image.convert("L") if mode in ("F", "1") else image.convert("RGB")).convert(mode)
            file = io.BytesIO()
            image.save(file, kind, **how)
            self._whole.append(file.getvalue())

    def run(self, rng: random.Random) -> None:
        whole = rng.choice(self._whole)
        head = min(len(whole), rng.choice((64, 256, len(whole))))
        self._path.write_bytes(damaged(rng, whole[:head]) + whole[head:] if rng.random() < 0.95 else whole)
        what = rng.choice(("photo", "photo", "mask", "depth"))
        if what == "depth":
            read_values(self._path)
            return
        size = training_size(*picture_size(self._path), -1)
        if what == "mask":
            pixels = Mask(self._path).decode(size)
        else:
            may_be_transparent(self._path)
            pixels = decode(self._path, size)
        assert pixels.shape[1:] == size[::-1], "another size than the header's"
