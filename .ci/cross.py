"""Build the C++ tests for another platform and run them here under an emulator, in each of its instruction sets.

python .ci/cross.py aarch64|windows|macos

aarch64: Linux on 64-bit Arm, by GCC, run by qemu-user. windows: on x86-64, by GCC (mingw-w64) and Zig's clang, run by
wine. macos: on 64-bit Arm, by Zig's clang, built and linked; no emulator runs these programs, so qemu-user runs those
that the same clang builds for Linux.

Results of the CPU backends are compared with this machine's: those of a baseline by bytes, others within rounding.
Tests of CUDA's emulation are left out. Zig comes from PyPI, into build/cross; .ci/install_emulators installs the rest.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import venv
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "build" / "cross"
EXTENSIONS = sorted(path.parent.name for path in ROOT.glob("submodules/*/setup.py"))
ZIG = "ziglang==0.17.1"
# Flags of submodules/common/build_extension.py that matter to results, and its instruction sets.
FLAGS = ("-std=c++17", "-O3", "-Wall", "-Wextra", "-Werror", "-fno-math-errno", "-fno-trapping-math", "-pthread")
ROUNDED = "-ffp-contract=off"
ARM64 = {"baseline": ("-DGS_PLAIN", ROUNDED), "neon": ()}


@dataclass(frozen=True)
class Target:
    """A compiler's command, the emulator of its programs (none: they are only built), and flags by instruction set."""

    name: str
    compiler: tuple[str, ...]
    emulator: tuple[str, ...]
    isas: dict[str, tuple[str, ...]]
    same_bytes: bool = True  # of the baseline's results


TARGETS = {
    "aarch64": [Target("aarch64", ("aarch64-linux-gnu-g++", "-static"), ("qemu-aarch64",), ARM64)],
    "windows": [
        Target(
            "windows",
            # GCC takes the stack for aligned to 32 bytes, which Windows does not do.
            ("x86_64-w64-mingw32-g++-posix", "-static", "-Wa,-muse-unaligned-vector-move"),
            ("wine64",),
            {"baseline": (), "avx2": ("-march=x86-64-v3",)},
            same_bytes=False,  # the logarithm of its C library rounds otherwise
        ),
        Target(
            "windows-clang",
            ("zig", "c++", "-target", "x86_64-windows-gnu"),
            ("wine64",),
            {"baseline": (), "avx2": ("-march=x86_64_v3",)},
            same_bytes=False,
        ),
    ],
    "macos": [
        Target("macos", ("zig", "c++", "-target", "aarch64-macos"), (), ARM64),
        Target("macos-clang", ("zig", "c++", "-target", "aarch64-linux-musl"), ("qemu-aarch64",), ARM64, False),
    ],
}
NATIVE = Target("native", tuple(shlex.split(os.environ.get("CXX", "c++"))), (), {"baseline": ("-DGS_PLAIN", ROUNDED)})


def run(command: list[str]) -> None:
    """Run a command; end with its output and status if it fails."""
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    if done.returncode:
        sys.exit(f"{shlex.join(command)}\n{done.stdout[-4000:]}failed with status {done.returncode}")


def in_parallel(commands: Iterator[list[str]]) -> None:
    """Run commands on all cores."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(run, commands))


def command_of(tool: tuple[str, ...]) -> list[str]:
    """The command line of a compiler or emulator; ends if it is missing."""
    name, *rest = tool
    if name == "zig":
        python = OUT / "zig" / "bin" / "python"
        if not python.exists():
            venv.create(OUT / "zig", with_pip=True)
            run([str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", ZIG])
        return [str(python), "-m", "ziglang", *rest]
    # Debian keeps wine64 outside of PATH.
    path = shutil.which(name, path=os.pathsep.join([os.environ["PATH"], "/usr/lib/wine"]))
    if path is None:
        sys.exit(f"there is no {name}: install it (on Debian and Ubuntu by .ci/install_emulators)")
    return [path, *rest]


def build(target: Target, isa: str, extension: str) -> Path:
    """Compile an extension's CPU backend and link it with each of its tests; return the programs' folder."""
    csrc = Path("submodules", extension, "csrc")
    folder = OUT / target.name / isa / extension
    folder.mkdir(parents=True, exist_ok=True)
    includes = [f"-I{folder}" for folder in (csrc, "submodules/common/include", "submodules/common/tests")]
    compiler = [*command_of(target.compiler), *FLAGS, *includes, *target.isas[isa]]

    def compilations() -> Iterator[list[str]]:
        for source in sorted((ROOT / csrc).rglob("cpu/*.cpp")):
            once = [] if source.stem.endswith("_isa") else [ROUNDED]
            yield [*compiler, *once, "-c", str(source), "-o", str(folder / f"{source.stem}.o")]

    def links() -> Iterator[list[str]]:
        objects = [str(path) for path in sorted(folder.glob("*.o"))]
        for source in tests(extension):
            yield [*compiler, "-O1", str(source), *objects, "-o", str(folder / f"{source.stem}.exe")]

    in_parallel(compilations())
    in_parallel(links())
    return folder


def tests(extension: str) -> list[Path]:
    """The sources of an extension's C++ tests, and of its program that writes results."""
    folder = ROOT / "submodules" / extension / "csrc" / "tests"
    found = [path for path in folder.glob("*.cpp") if "emulated" not in path.stem]
    return sorted([*found, *(folder / "platforms").glob("*.cpp")])


def check(target: Target, isa: str, extension: str) -> None:
    """Build an extension's tests, run them, and compare its results with this machine's."""
    print(f"== {target.name} {isa} {extension}", flush=True)
    folder = build(target, isa, extension)
    if not target.emulator:
        print(f"{len(tests(extension))} programs built, none run")
        return
    emulator = command_of(target.emulator)
    for source in tests(extension):
        program = folder / f"{source.stem}.exe"
        if source.stem == "write_results":
            compare([*emulator, str(program)], folder, extension, isa == "baseline" and target.same_bytes)
        else:
            print(end="", flush=True)
            if subprocess.run([*emulator, str(program)]).returncode:
                sys.exit(f"{target.name} {isa}: {source.stem} of {extension} failed")


def compare(program: list[str], folder: Path, extension: str, bytes_too: bool) -> None:
    """Compare the results that a program writes with those of this machine's baseline."""
    wanted, got = native_results(extension), folder / "results"
    if subprocess.run([*program, str(got), str(wanted)]).returncode:
        sys.exit(f"the results of {extension} differ by more than rounding from this machine's")
    same = got.read_bytes() == wanted.read_bytes()
    print(f"the results of {extension} {'have the same bytes as' if same else 'are within rounding of'} this machine's")
    if bytes_too and not same:
        sys.exit(f"the baseline's results of {extension} must have the same bytes")


@cache
def native_results(extension: str) -> Path:
    """The results of this machine's baseline."""
    folder = build(NATIVE, "baseline", extension)
    run([str(folder / "write_results.exe"), str(folder / "results")])
    return folder / "results"


def main() -> None:
    """Check one platform."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("platform", choices=sorted(TARGETS))
    platform = parser.parse_args().platform
    os.environ |= {"WINEDEBUG": "-all", "WINEPREFIX": str(OUT / "wine"), "ZIG_GLOBAL_CACHE_DIR": str(OUT / "zig-cache")}
    OUT.mkdir(parents=True, exist_ok=True)
    for target in TARGETS[platform]:
        for isa in target.isas:
            for extension in EXTENSIONS:
                check(target, isa, extension)


if __name__ == "__main__":
    main()
