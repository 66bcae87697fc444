"""Faults that other programs have had, each as a substitution in one of our sources.

origin is where the fault was. Ours is of its kind: our sources have other formulas.
"""

from pathlib import Path
from typing import NamedTuple

CSRC = "submodules/diff-gaussian-rasterization/csrc"


class Fault(NamedTuple):
    """old, which the file has exactly once, becomes new."""

    name: str
    origin: str
    file: str
    old: str
    new: str

    @property
    def on_gpu(self) -> bool:
        """True if the fault is in CUDA kernels alone, which run in emulation here."""
        return "/cuda/" in self.file

    def apply(self, text: str) -> str:
        """The altered text of the file; ValueError if it does not have the place exactly once."""
        if (count := text.count(self.old)) != 1:
            raise ValueError(f"{self.name}: {self.file} has {count} places, not 1, with {self.old!r}; change faults.py")
        return text.replace(self.old, self.new)


FAULTS = (
    Fault(
        "absolute gradients zero",
        "FastGS#35",
        f"{CSRC}/math/absolute.h",
        "return length(",
        "return T(0) * length(",
    ),
    Fault(
        "no gradient through the compensation",
        "gsplat#140",
        f"{CSRC}/math/footprint.h",
        "if (antialiasing && any(!f.floored)) {",
        "if (antialiasing && false) {",
    ),
    Fault(
        "wrong derivative of the 2D filter",
        "Faster-GS 0244d1e",
        f"{CSRC}/math/footprint.h",
        "inverse_ratio = 1 / (f.compensation * f.compensation)",
        "inverse_ratio = 1 / f.compensation",
    ),
    Fault(
        "half of a warp's lanes not summed",
        "ROCm/gsplat#18",
        f"{CSRC}/cuda/backward/pixel_sums.cuh",
        "        kept[i] = v[i] + __shfl_xor_sync(kWarp, v[i], kStep);\n",
        "        kept[i] = v[i];\n",
    ),
    Fault(
        "mean on a tile's border pixel culled",
        "Faster-GS 44a13d1",
        f"{CSRC}/math/tiles.h",
        "beside = (x0 > T(0)) | (x1 < T(0)), above = (y0 > T(0)) | (y1 < T(0));",
        "beside = (x0 >= T(0)) | (x1 <= T(0)), above = (y0 >= T(0)) | (y1 <= T(0));",
    ),
    Fault(
        "fewer tiles written than counted",
        "brush#411",
        f"{CSRC}/cpu/bin_isa.cpp",
        "  list_tiles(splat, rect, image, in.table, mask, tiles);\n",
        "  splat.log2_opacity -= T(1e-4);\n  list_tiles(splat, rect, image, in.table, mask, tiles);\n",
    ),
    Fault(
        "clamp without its derivative",
        "many",
        f"{CSRC}/math/projection.h",
        "g_ray_x = p.clamped_x == p.ray_x ? g_ray_x - cam",
        "g_ray_x = p.clamped_x == p.clamped_x ? g_ray_x - cam",
    ),
    Fault(
        "sort by the depth of the splat before",
        "many",
        f"{CSRC}/cpu/bin_isa.cpp",
        "std::memcpy(&key, in.depths + i, sizeof key);",
        "std::memcpy(&key, in.depths + (i ? i - 1 : i), sizeof key);",
    ),
    Fault(
        "second moment decays twice",
        "many",
        f"{CSRC}/math/adam.h",
        "Lanes::all(a.keep2), square",
        "Lanes::all(a.keep2 * a.keep2), square",
    ),
)


def check(tree: Path) -> None:
    """ValueError if a fault does not fit the sources of a tree."""
    for fault in FAULTS:
        fault.apply((tree / fault.file).read_text())
