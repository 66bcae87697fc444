"""The lens that took a photo, as the photo's EXIF data tell it."""

import math
from pathlib import Path
from typing import Any, NamedTuple

from PIL import ExifTags

from splatting.files.image_files import UNREADABLE, open_image


class Lens(NamedTuple):
    """What EXIF says: names, focal lengths (mm) of the lens and of one on 35 mm film, digital zoom; "" and 0 if not.

    Photos of equal records went through one lens: a phone that crops for its 2x says so by `film` or by `zoom`.
    """

    make: str = ""
    model: str = ""
    lens: str = ""
    focal: float = 0.0
    film: float = 0.0
    zoom: float = 0.0

    @property
    def known(self) -> bool:
        """Whether the record tells lenses of one device apart."""
        return bool(self.lens or self.focal or self.film)

    @property
    def length(self) -> float:
        """The focal length as far as it shows in the photo, in mm; 0 if unknown. Compares within one device."""
        return self.film or self.focal * (self.zoom or 1.0)

    def __str__(self) -> str:
        device = self.model if self.model.startswith(self.make) else f"{self.make} {self.model}".strip()
        parts = [device, self.lens]
        if self.focal:
            parts.append(f"{self.focal:g} mm" + (f" (as {self.film:g} mm on 35 mm film)" if self.film else ""))
        elif self.film:
            parts.append(f"as {self.film:g} mm on 35 mm film")
        if self.zoom:
            parts.append(f"digital zoom {self.zoom:g}")
        return ", ".join(filter(None, parts)) or "a lens that EXIF does not name"


def read_lens(photo: Path) -> Lens:
    """Read a photo's lens from its header; fields that are missing or damaged are empty."""
    try:
        with open_image(photo) as image:
            exif = image.getexif()
            more = exif.get_ifd(ExifTags.IFD.Exif)
    except UNREADABLE:
        return Lens()
    tag = ExifTags.Base
    zoom = _number(more.get(tag.DigitalZoomRatio))
    return Lens(
        _text(exif.get(tag.Make)),
        _text(exif.get(tag.Model)),
        _text(more.get(tag.LensModel)),
        _number(more.get(tag.FocalLength)),
        _number(more.get(tag.FocalLengthIn35mmFilm)),
        0.0 if zoom == 1 else zoom,  # programs write no zoom as 0, as 1, or not at all
    )


def _text(value: Any) -> str:
    text = value.decode("utf-8", "replace") if isinstance(value, bytes) else value
    return " ".join("".join(c if c.isprintable() else " " for c in text).split()) if isinstance(text, str) else ""


def _number(value: Any) -> float:
    """Round to a hundredth: a fraction may be written in several ways."""
    try:
        number = float(value)
    except (TypeError, ValueError, ArithmeticError):
        return 0.0
    return round(number, 2) if math.isfinite(number) and number > 0 else 0.0
