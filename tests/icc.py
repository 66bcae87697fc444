"""ICC profiles for tests: of primaries and a gamma, of grey, and of a simple CMYK printer (ICC.1:2001-04)."""

import struct

import numpy as np

_WHITE = (0.9642, 1.0, 0.8249)  # D50
# Columns are the XYZ of red, green and blue, adapted to D50.
_XYZ = {
    "Display P3": ((0.51512, 0.29198, 0.15710), (0.24120, 0.69225, 0.06657), (-0.00105, 0.04189, 0.78407)),
    "Adobe RGB": ((0.60974, 0.20528, 0.14919), (0.31111, 0.62567, 0.06322), (0.01947, 0.06087, 0.74457)),
    "ProPhoto": ((0.79767, 0.13519, 0.03135), (0.28804, 0.71187, 0.00009), (0.0, 0.0, 0.82510)),
    "sRGB": ((0.43607, 0.38515, 0.14307), (0.22249, 0.71690, 0.06061), (0.01392, 0.09708, 0.71410)),
}
_GAMMA = {"Display P3": 0.0, "Adobe RGB": 2.19921875, "ProPhoto": 1.8, "sRGB": 0.0}  # 0: the curve of sRGB


def rgb_profile(name: str) -> bytes:
    """The profile of a space of _XYZ."""
    curve = _curve(_GAMMA[name])
    columns = zip(("rXYZ", "gXYZ", "bXYZ"), np.transpose(_XYZ[name]), strict=True)
    tags = {tag: _xyz(column) for tag, column in columns} | dict.fromkeys(("rTRC", "gTRC", "bTRC"), curve)
    return _file("RGB ", "XYZ ", name, tags)


def grey_profile(gamma: float) -> bytes:
    """A profile of grey."""
    return _file("GRAY", "XYZ ", f"Gray Gamma {gamma}", {"kTRC": _curve(gamma)})


def cmyk_profile() -> bytes:
    """A printer whose lightness falls with black alone, so that grey is L = 100 (1 - K)."""
    grid = np.stack(np.meshgrid(*[[0, 1]] * 4, indexing="ij"), -1).reshape(-1, 4)  # C, M, Y, K; K runs fastest
    lightness = 255 * (1 - grid[:, 3])
    lab = np.stack([lightness, np.full(16, 128), np.full(16, 128)], -1).astype(np.uint8).tobytes()
    identity = b"".join(struct.pack(">i", 65536 * (n % 4 == 0)) for n in range(9))
    ramp = bytes(range(256))
    table = b"mft1" + bytes(4) + bytes([4, 3, 2, 0]) + identity + ramp * 4 + lab + ramp * 3
    return _file("CMYK", "Lab ", "Printer", {"A2B0": table}, b"prtr")


def to_srgb(colors: np.ndarray, name: str) -> np.ndarray:
    """Convert colours (..., 3) of 0 to 1 from a space to sRGB, clipped: by the formulas, without any library."""
    gamma = _GAMMA[name]
    linear = colors**gamma if gamma else np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    other = np.clip(linear @ np.transpose(_XYZ[name]) @ np.linalg.inv(np.transpose(_XYZ["sRGB"])), 0, 1)
    return np.where(other <= 0.0031308, 12.92 * other, 1.055 * other ** (1 / 2.4) - 0.055)


def _curve(gamma: float) -> bytes:
    if gamma:
        return b"curv" + bytes(4) + struct.pack(">IH", 1, round(256 * gamma)) + bytes(2)
    steps = np.linspace(0, 1, 1024)
    values = np.where(steps <= 0.04045, steps / 12.92, ((steps + 0.055) / 1.055) ** 2.4)
    return b"curv" + bytes(4) + struct.pack(">I", 1024) + np.round(values * 65535).astype(">u2").tobytes()


def _xyz(values: tuple[float, ...] | np.ndarray) -> bytes:
    return b"XYZ " + bytes(4) + struct.pack(">3i", *(round(65536 * value) for value in values))


def _file(space: str, connected: str, name: str, tags: dict[str, bytes], kind: bytes = b"mntr") -> bytes:
    text = b"desc" + bytes(4) + struct.pack(">I", len(name) + 1) + name.encode() + bytes(1 + 78)
    tags = tags | {"desc": text + bytes(-len(text) % 4), "wtpt": _xyz(_WHITE)}
    place, table, content = 128 + 4 + 12 * len(tags), struct.pack(">I", len(tags)), b""
    for tag, data in tags.items():
        table += tag.encode() + struct.pack(">2I", place + len(content), len(data))
        content += data + bytes(-len(data) % 4)
    head = struct.pack(">I4sI4s4s4s", place + len(content), b"", 0x02400000, kind, space.encode(), connected.encode())
    head += bytes(12) + b"acsp" + bytes(28) + struct.pack(">3i", *(round(65536 * x) for x in _WHITE))
    return head.ljust(128, b"\0") + table + content
