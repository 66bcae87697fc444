"""A private copy of the project, which is built with one fault at a time.

Only what includes an altered file is compiled again; the compiler has noted what does. The library has one instruction
set, because compiling for all takes three times as long.
"""

import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from shutil import copyfile, copytree, rmtree
from types import ModuleType

import torch

from mutations.faults import CSRC, Fault

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "diff_gaussian_rasterization"
TESTS = f"build/{CSRC.removeprefix('submodules/')}/tests"  # where make builds the C++ tests
EMULATED = f"{TESTS}/test_cuda_emulated"  # which runs the CUDA kernels on the CPU


def _builder(tree: Path) -> ModuleType:
    sys.path.insert(0, str(tree / "submodules" / "common"))
    import build_extension

    return build_extension


def _needs(made: Path) -> list[Path]:
    """Files that an object was made from, by the compiler's note beside it."""
    note = made.with_suffix(".d").read_text().replace("\\\n", " ")
    return [Path(os.path.normpath(word)) for word in note.partition(":")[2].split()]


class PrivateCopy:
    """The project in folder/tree, its library in folder/packages, and objects of the sources as they are."""

    def __init__(self, folder: Path) -> None:
        """Copy what has changed since the last time, and build it: minutes at first."""
        folder = folder.resolve()
        self.tree, self._folder, self._packages = folder / "tree", folder, folder / "packages"
        self._copy()
        self._builder = build = _builder(self.tree)
        self._compiler, objects = build.find_compiler(), folder / "objects"
        objects.mkdir(exist_ok=True)
        plan = build.compilations(torch, [*self._compiler, "-MMD", "-w"], None, self.tree / CSRC, objects)
        others = tuple(f".{isa}.o" for isa in {*build.X86_ISAS, *build.ARM64_ISAS} - {"baseline"})
        several = ("-DGS_X86", "-DGS_ARM64")  # what tells sources that there are several instruction sets
        self._plan = [
            one._replace(command=[word for word in one.command if word not in several])
            for one in plan
            if not one.output.name.endswith(others)
        ]
        self._compile([one for one in self._plan if self._is_old(one.output)])
        self._link()
        self.run(["make", *self._make, EMULATED])

    def run(self, command: Sequence[str]) -> None:
        """Run a program in the copy; RuntimeError with its output if it fails."""
        done = subprocess.run(command, cwd=self.tree, env=self.environment(), capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"{' '.join(command)}\n{done.stdout[-4000:]}{done.stderr[-4000:]}")

    def environment(self) -> dict[str, str]:
        """Variables of programs that use the copy. They see no GPU."""
        more = {"PYTHONPATH": str(self._packages), "GS_ISA": "baseline", "CUDA_VISIBLE_DEVICES": ""}
        return os.environ | {"OMP_NUM_THREADS": "1"} | more

    @contextmanager
    def altered(self, fault: Fault) -> Iterator[None]:
        """The copy with a fault, built; afterwards as before."""
        path = self.tree / fault.file
        text, times = path.read_text(), path.stat()

        def write(content: str) -> None:
            path.write_text(content)
            os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))  # nothing counts as old by it

        build = self._emulate if fault.on_gpu else self._build
        try:
            write(fault.apply(text))
            build(path)
            yield
        finally:
            write(text)
            if fault.on_gpu:
                build(path)
            else:
                self._link()

    def _copy(self) -> None:
        """Copy the files that git knows or would take; those that are equal keep their time."""
        command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
        listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
        names = {name for name in listed.split("\0") if (ROOT / name).is_file()}
        for name in names:
            source, target = ROOT / name, self.tree / name
            if not target.is_file() or source.read_bytes() != target.read_bytes():
                target.parent.mkdir(parents=True, exist_ok=True)
                copyfile(source, target)
        for path in self.tree.rglob("*"):
            name = path.relative_to(self.tree)
            if path.is_file() and name.parts[0] != "build" and str(name) not in names:
                path.unlink()

    @property
    def _make(self) -> list[str]:
        return [f"-j{os.cpu_count()}", f"PYTHON={sys.executable}", f"CXX={' '.join(self._compiler)} -MMD"]

    def _is_old(self, made: Path) -> bool:
        if not made.exists():
            return True
        return any(not path.exists() or path.stat().st_mtime > made.stat().st_mtime for path in _needs(made))

    def _compile(self, plan: Sequence) -> None:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(self._builder.compile_one, plan))

    def _link(self, instead: Sequence[Path] = ()) -> None:
        """Make the package. instead: objects that take the place of those of the same name."""
        rmtree(self._packages, ignore_errors=True)
        package, replaced = self._packages / PACKAGE, {path.name: path for path in instead}
        copytree(self.tree / CSRC / ".." / PACKAGE, package)
        for path in (self.tree / "submodules/common/package").glob("*.py"):
            copyfile(path, package / path.name)
        objects = [replaced.get(one.output.name, one.output) for one in self._plan]
        self._builder.link(torch, self._compiler, None, objects, package / "_backend.so")

    def _build(self, path: Path) -> None:
        """Build the library with an altered file."""
        folder = self._folder / "altered"
        rmtree(folder, ignore_errors=True)
        folder.mkdir()
        plan = [one._replace(output=folder / one.output.name) for one in self._plan if path in _needs(one.output)]
        if path.is_relative_to(self.tree / CSRC) and not plan:
            raise RuntimeError(f"nothing is made from {path}")
        self._compile(plan)
        self._link([one.output for one in plan])

    def _emulate(self, path: Path) -> None:
        """Build the test of the CUDA kernels, with an altered source of theirs."""
        source = path.relative_to(self.tree)
        made = Path(TESTS, "emulated", source.relative_to(CSRC))
        made = made.with_suffix(".cpp") if made.suffix == ".cu" else made
        self.run([sys.executable, "submodules/common/emulation/translate.py", CSRC, f"{TESTS}/emulated"])
        for note in (self.tree / TESTS).rglob("*.d"):
            if made in _needs(note):
                note.with_suffix(".o").unlink(missing_ok=True)
        (self.tree / EMULATED).unlink(missing_ok=True)  # or make would do without the objects
        self.run(["make", *self._make, EMULATED])
