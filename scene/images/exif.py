"""Lens, place and vertical of a photo, from its EXIF data and DJI's XMP."""

import math
import re
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import ExifTags

from groundwork.files.image_files import UNREADABLE, open_image

_APPLE = b"Apple iOS\0"
_ACCELERATION = 8  # tag of Apple's notes: three signed rationals (ExifTool, "Apple Tags", AccelerationVector)
_SIGNED_RATIONAL = 10
_BELOW = ("\x01", "\x03", "1", "3")  # references of an altitude below the sea, or below the ellipsoid (EXIF 3.0)
_DJI = re.compile(r'drone-dji:((?:Gps|Gimbal|Absolute)\w+)(?:\s*=\s*["\']|>)\s*([-+]?\d+(?:\.\d+)?)')
# What turns (right, down) of the stored pixels to those of the upright photo, by EXIF orientation.
_UPRIGHT = {1: (1, 0, 0, 1), 3: (-1, 0, 0, -1), 6: (0, -1, 1, 0), 8: (0, 1, -1, 0)}


class Lens(NamedTuple):
    """EXIF data of a lens: names, focal lengths (mm), real and on 35 mm film, digital zoom; "" and 0 if missing.

    Photos with equal records were taken by one lens: a phone that crops for its 2x records that in `film` or `zoom`.
    """

    make: str = ""
    model: str = ""
    lens: str = ""
    focal: float = 0.0
    film: float = 0.0
    zoom: float = 0.0

    @property
    def is_distinct(self) -> bool:
        """True if the record tells lenses of one device apart."""
        return bool(self.lens or self.focal or self.film)

    @property
    def length(self) -> float:
        """The focal length as far as it shows in the photo, in mm; 0 if unknown. Compares within one device."""
        return self.film or self.focal * (self.zoom or 1.0)

    def __str__(self) -> str:
        """Describe the lens in words, for messages."""
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
    zoom = _round_number(more.get(tag.DigitalZoomRatio))
    return Lens(
        _read_text(exif.get(tag.Make)),
        _read_text(exif.get(tag.Model)),
        _read_text(more.get(tag.LensModel)),
        _round_number(more.get(tag.FocalLength)),
        _round_number(more.get(tag.FocalLengthIn35mmFilm)),
        0.0 if zoom == 1 else zoom,  # programs write no zoom as 0, as 1, or not at all
    )


def _read_text(value: Any) -> str:
    text = value.decode("utf-8", "replace") if isinstance(value, bytes) else value
    return " ".join("".join(c if c.isprintable() else " " for c in text).split()) if isinstance(text, str) else ""


def _round_number(value: Any) -> float:
    """Round to a hundredth: a fraction may be written in several ways."""
    try:
        number = float(value)
    except (TypeError, ValueError, ArithmeticError):
        return 0.0
    return round(number, 2) if math.isfinite(number) and number > 0 else 0.0


class PhotoPlace(NamedTuple):
    """gps: latitude and longitude in degrees, height in metres (NaN: unknown), or None. down: (3,) of length 1 in the
    axes of the upright photo's camera (x right, y down, z forward), or None."""

    gps: tuple[float, float, float] | None = None
    down: np.ndarray | None = None


def read_place(photo: Path) -> PhotoPlace:
    """Read both from a photo's header; what is missing or damaged is None."""
    try:
        with open_image(photo) as image:
            exif = image.getexif()
            gps, more = exif.get_ifd(ExifTags.IFD.GPSInfo), exif.get_ifd(ExifTags.IFD.Exif)
            xmp = _read_dji(image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or b"")
    except UNREADABLE:
        return PhotoPlace()
    note, orientation = more.get(ExifTags.Base.MakerNote), exif.get(ExifTags.Base.Orientation, 1)
    down = _compute_down(note, orientation) if isinstance(note, bytes) else None
    if down is None and orientation == 1 and "GimbalPitchDegree" in xmp:
        pitch, roll = (math.radians(xmp.get(f"Gimbal{angle}Degree", 0.0)) for angle in ("Pitch", "Roll"))
        down = np.array([math.sin(roll) * math.cos(pitch), math.cos(roll) * math.cos(pitch), -math.sin(pitch)])
    return PhotoPlace(_refine(_read_gps(gps), xmp), down)


def _read_dji(xmp: bytes | str) -> dict[str, float]:
    """The numbers that a drone by DJI writes, by their names there: degrees, and metres; pitch is -90 straight down."""
    text = xmp.decode("utf-8", "replace") if isinstance(xmp, bytes) else xmp
    return {name: float(value) for name, value in _DJI.findall(text)}


def _refine(gps: tuple[float, float, float] | None, xmp: Mapping[str, float]) -> tuple[float, float, float] | None:
    """A place by DJI's numbers, which have more digits than EXIF's, where there are such."""
    latitude, longitude = xmp.get("GpsLatitude"), xmp.get("GpsLongitude", xmp.get("GpsLongtitude"))  # as some spell it
    tags = {ExifTags.GPS.GPSLatitude: latitude, ExifTags.GPS.GPSLongitude: longitude}
    height = xmp.get("AbsoluteAltitude", gps[2] if gps else math.nan)
    return _read_gps({**tags, ExifTags.GPS.GPSAltitude: height}) or gps


def _read_gps(tags: Mapping[int, Any]) -> tuple[float, float, float] | None:
    """Read latitude and longitude (degrees) and height (metres) from GPS tags; None without a plausible place."""
    tag = ExifTags.GPS
    try:
        latitude = _read_degrees(tags[tag.GPSLatitude], tags.get(tag.GPSLatitudeRef, ""), "NS")
        longitude = _read_degrees(tags[tag.GPSLongitude], tags.get(tag.GPSLongitudeRef, ""), "EW")
    except (KeyError, TypeError, ValueError):
        return None
    if 180 < longitude <= 360:  # counted to the east alone
        longitude -= 360
    height, below = _read_metres(tags.get(tag.GPSAltitude)), _read_reference(tags.get(tag.GPSAltitudeRef)) in _BELOW
    sound = abs(latitude) <= 90 and abs(longitude) <= 180 and (latitude or longitude)
    return (latitude, longitude, -abs(height) if below else height) if sound else None


def _read_metres(value: Any) -> float:
    """A height, NaN if it is missing or damaged."""
    try:
        height = float(value[0] if isinstance(value, tuple) else value)
    except (TypeError, ValueError, LookupError):
        return math.nan
    return height if math.isfinite(height) else math.nan


def _read_degrees(parts: Any, reference: Any, letters: str) -> float:
    """Degrees of one to three parts: degrees, minutes, seconds. ValueError if they are damaged.

    letters: what the reference begins with where they are positive, and negative. Without one, the sign counts; another
    letter is damage, as O is east in some languages and west in others.
    """
    values = [*map(float, parts if isinstance(parts, tuple) else [parts])]
    while len(values) > 1 and math.isnan(values[-1]):  # 0/0, as of seconds that minutes tell
        values.pop()
    if not 1 <= len(values) <= 3 or not all(map(math.isfinite, values)):
        raise ValueError(f"{parts} are no degrees")
    angle = sum(abs(value) / 60**place for place, value in enumerate(values))
    letter = _read_reference(reference)[:1]
    if letter.isalpha() and letter not in letters:
        raise ValueError(f"{reference} is no direction")
    negative = letter == letters[1] if letter and letter in letters else min(values) < 0
    return -angle if negative else angle


def _read_reference(value: Any) -> str:
    """A reference, which some programs write as bytes, as a number, or with blanks, as text."""
    text = value.decode("latin-1") if isinstance(value, bytes) else str(value)
    return text.strip("\0\t\r\n ").upper()


def _compute_down(note: bytes, orientation: Any) -> np.ndarray | None:
    """Down by an Apple note: acceleration in the device's axes, x right, y to its top, z out of its screen.

    A phone that lies on its back has (0, 0, -1). Its rear camera's stored pixels have their right at the device's
    bottom, and their lower side at its left.
    """
    vector = _read_acceleration(note)
    if vector is None or orientation not in _UPRIGHT:
        return None
    length = float(np.linalg.norm(vector))
    if not 0.8 < length < 1.2:  # shaken, or damaged
        return None
    x, y, z = vector / length
    right, low = -y, -x
    a, b, c, d = _UPRIGHT[orientation]
    return np.array([a * right + b * low, c * right + d * low, -z])


def _read_acceleration(note: bytes) -> np.ndarray | None:
    """The vector (3,) of an Apple note, a big-endian directory whose offsets count from its first byte."""
    if not note.startswith(_APPLE) or note[12:14] != b"MM":
        return None
    try:
        for entry in range(*_list_entries(note)):
            tag, kind, count, offset = struct.unpack_from(">HHII", note, entry)
            if (tag, kind, count) == (_ACCELERATION, _SIGNED_RATIONAL, 3):
                values = np.array(struct.unpack_from(">6i", note, offset), np.float64).reshape(3, 2)
                return values[:, 0] / values[:, 1] if values[:, 1].all() else None
    except struct.error:
        pass
    return None


def _list_entries(note: bytes) -> tuple[int, int, int]:
    (count,) = struct.unpack_from(">H", note, 14)
    return 16, 16 + 12 * count, 12
