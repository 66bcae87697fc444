"""Translate .cu files to C++ that compiles with the headers of this folder.

python translate.py CSRC FOLDER    writes the translations of CSRC/cuda/X.cu and X.cuh to FOLDER/cuda/X.cpp and X.cuh
"""

import re
import sys
from pathlib import Path

# kernel<A, B><<<grid, block, shared, stream>>>(arguments)
_LAUNCH = re.compile(r"([A-Za-z_]\w*(?:<[\w, :]*>)?)\s*<<<(.*?)>>>", re.DOTALL)
_DYNAMIC_SHARED = re.compile(r"extern __shared__ ([\w:]+) (\w+)\[\];")


def translate(source: str) -> str:
    """Translate the text of a .cu file to C++; ValueError if some CUDA syntax is left."""
    source = _DYNAMIC_SHARED.sub(r"\1* \2 = static_cast<\1*>(gs::emulation::dynamic_shared());", source)
    source = _LAUNCH.sub(r"gs::emulation::launch(\2, [=](auto... arguments) { \1(arguments...); })", source)
    for rest in ("<<<", "asm(", "extern __shared__"):
        if rest in source:
            raise ValueError(f"the emulation cannot translate {rest!r}")
    return source


if __name__ == "__main__":
    csrc, folder = map(Path, sys.argv[1:])
    for path in csrc.rglob("*.cu*"):
        to = folder / path.relative_to(csrc)
        to.parent.mkdir(parents=True, exist_ok=True)
        to.with_suffix(".cpp" if path.suffix == ".cu" else ".cuh").write_text(
            f'#line 1 "{path}"\n' + translate(path.read_text())
        )
