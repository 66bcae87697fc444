"""ICC profiles for photos that have none, from other fields of their files.

EXIF: Adobe RGB (DCF 2.0). PNG: cICP, sRGB, gAMA and cHRM. HEIC and AVIF: nclx, with the code points of ITU-T H.273.
"""

import contextlib
import functools
import struct
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

UNKNOWN = "unknown_colors"  # key of Image.info: what a photo says of its colours that cannot be followed
HDR = {16: "PQ", 18: "HLG"}  # code points of transfer curves
_WHITE = 0.3127, 0.3290  # x and y of D65, as those of red, green and blue
_SRGB = *_WHITE, 0.64, 0.33, 0.30, 0.60, 0.15, 0.06
_ADOBE = *_WHITE, 0.64, 0.33, 0.21, 0.71, 0.15, 0.06
_NAMED = {
    1: ("sRGB", _SRGB),
    5: ("BT.601", (*_WHITE, 0.64, 0.33, 0.29, 0.60, 0.15, 0.06)),
    6: ("BT.601", (*_WHITE, 0.630, 0.340, 0.310, 0.595, 0.155, 0.070)),
    9: ("BT.2020", (*_WHITE, 0.708, 0.292, 0.170, 0.797, 0.131, 0.046)),
    12: ("Display P3", (*_WHITE, 0.680, 0.320, 0.265, 0.690, 0.150, 0.060)),
}  # by the code point of the primaries
_POWERS = dict.fromkeys((1, 2, 6, 13, 14, 15), 0.0) | {4: 2.2, 5: 2.8, 8: 1.0}  # 0: photos have the curve of sRGB
_ADOBE_POWER = 563 / 256
_UNSPECIFIED = 2
_D50 = 0.9642, 1.0, 0.8249
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
_CURVE = 2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045  # of sRGB, as ICC's parametric curve of type 3


def add_profile(image: Image.Image, path: Path) -> None:
    """Give an opened photo the profile that its file describes, or note under UNKNOWN why there is none."""
    if image.info.get("icc_profile"):
        return
    with contextlib.suppress(OSError, SyntaxError, ValueError, TypeError, LookupError, ArithmeticError, struct.error):
        # Damaged data tell nothing.
        points = code_points(path, image.format)
        if points and points[0] != _UNSPECIFIED:
            (name, colors), power = _NAMED.get(points[0], ("", ())), _POWERS.get(points[1])
            if not name or power is None:
                curve = HDR.get(points[1], points[1])
                image.info[UNKNOWN] = f"primaries {name or points[0]} and transfer curve {curve} (ITU-T H.273)"
                return
        elif image.format == "PNG" and not {"gamma", "chromaticity"}.isdisjoint(image.info):
            name, colors = "of the PNG chunks gAMA and cHRM", image.info.get("chromaticity", _SRGB)
            is_usual = abs(2.2 * image.info.get("gamma", 1 / 2.2) - 1) < 0.02 and np.allclose(colors, _SRGB, atol=0.01)
            power = 0.0 if is_usual or "gamma" not in image.info else 1 / image.info["gamma"]
            if is_usual or "srgb" in image.info:
                return
        elif _is_adobe(image):
            name, colors, power = "Adobe RGB", _ADOBE, _ADOBE_POWER
        else:
            return
        if colors != _SRGB or power:
            image.info["icc_profile"] = _make_profile(name, tuple(colors), power)


def code_points(path: Path, kind: str | None) -> tuple[int, int] | None:
    """The code points of primaries and transfer curve in a PNG, HEIC or AVIF file, None: it has none."""
    if kind not in ("PNG", "AVIF", "HEIF"):
        return None
    with open(path, "rb") as file:
        if kind == "PNG":
            place = 8
            while (head := file.seek(place) and file.read(10))[4:8] not in (b"", b"IDAT", b"IEND"):
                if head[4:8] == b"cICP":
                    return head[8], head[9]
                place += 12 + int.from_bytes(head[:4], "big")
            return None
        head = file.read(1 << 16)
    found = head.find(b"colrnclx")  # then two bytes each
    return struct.unpack(">2H", head[found + 8 : found + 12]) if found >= 0 else None


def _is_adobe(image: Image.Image) -> bool:
    """Tell whether EXIF says that a photo's colours are of Adobe RGB."""
    if "exif" in image.info:
        exif = Image.Exif()  # one of its own, as `get_ifd` adds to what is written later
        exif.load(image.info["exif"])
    elif image.format == "TIFF":
        exif = image.getexif()
    else:
        return False
    more = exif.get_ifd(ExifTags.IFD.Exif) if ExifTags.IFD.Exif in exif else {}
    space = more.get(ExifTags.Base.ColorSpace, 1)
    if space in (1, 2) or ExifTags.IFD.Interop not in more:
        return space == 2
    return str(exif.get_ifd(ExifTags.IFD.Interop).get(ExifTags.Interop.InteropIndex)).strip("\0 ") == "R03"


def mark_srgb(exif: Image.Exif) -> None:
    """Write into a photo's EXIF data that its colours are sRGB."""
    if ExifTags.IFD.Exif in exif and ExifTags.Base.ColorSpace in (more := exif.get_ifd(ExifTags.IFD.Exif)):
        more[ExifTags.Base.ColorSpace] = 1


@functools.lru_cache(maxsize=16)
def _make_profile(name: str, colors: tuple[float, ...], power: float) -> bytes:
    """An ICC profile (ICC.1:2010). colors: x and y of white, red, green and blue. power: 0 for the curve of sRGB."""
    x, y = np.reshape(colors, (4, 2)).T
    white, *primaries = np.stack([x / y, np.ones(4), (1 - x - y) / y], 1)
    columns = np.transpose(primaries) * np.linalg.solve(np.transpose(primaries), white)
    adapted = np.linalg.solve(_BRADFORD, np.diag(_BRADFORD @ _D50 / (_BRADFORD @ white)) @ _BRADFORD @ columns)
    numbers = [power] if power else _CURVE
    curve = struct.pack(">4s4xH2x", b"para", 0 if power else 3) + _encode_fixed_point(numbers)
    text = name.encode("utf-16-be") + b"\0\0" * (len(name) % 2)
    tags = {b"desc": struct.pack(">4s4x2I4s2I", b"mluc", 1, 12, b"enUS", len(text), 28) + text}
    tags |= {b"wtpt": b"XYZ \0\0\0\0" + _encode_fixed_point(_D50)}
    for channel, column in zip((b"r", b"g", b"b"), adapted.T, strict=True):
        tags |= {channel + b"XYZ": b"XYZ \0\0\0\0" + _encode_fixed_point(column), channel + b"TRC": curve}
    start, table, content = 132 + 12 * len(tags), struct.pack(">I", len(tags)), b""
    for tag, data in tags.items():
        table += tag + struct.pack(">2I", start + len(content), len(data))
        content += data
    head = struct.pack(">I4xI4s4s4s12x4s28x", start + len(content), 0x04200000, b"mntr", b"RGB ", b"XYZ ", b"acsp")
    return (head + _encode_fixed_point(_D50)).ljust(128, b"\0") + table + content


def _encode_fixed_point(values: np.ndarray | tuple[float, ...] | list[float]) -> bytes:
    return np.round(np.asarray(values) * 65536).astype(">i4").tobytes()
