"""Builds torch extensions with a CPU backend and, once they have kernels, a CUDA one.

Sources are those below a folder `cpu`, `cuda` or `torch` at any depth of csrc.

Each extension's setup.py calls `setup_extension`, and the repository's own passes `extension_options` for all of them;
pip does the rest. The result is <package>/_backend.so, which registers its operators when torch.ops.load_library loads
it. It takes only C functions from torch, those of torch's stable interface, so that it runs with every torch from
OLDEST_TORCH on, and a torch without CUDA is enough to build CUDA kernels. It takes nothing from Python, so that a wheel
serves every Python from 3.10 on. setuptools' own extension builder and torch's know neither several instruction sets of
one source nor parallel compilation without ninja, so this runs the commands.

Environment: CXX (compiler), CUDA_HOME (toolkit), GS_CUDA=0|1 (never, or always, build CUDA; unset: where nvcc is
found and torch was built with CUDA), TORCH_CUDA_ARCH_LIST ("9.0" or "8.0;9.0+PTX"; unset: those of the GPUs that are
visible, or with none 7.5 and all major ones from 8.0).
"""

import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, NoReturn

from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext
from setuptools.command.build_py import build_py

VERSION = (Path(__file__).resolve().parents[2] / "version.txt").read_text(encoding="utf-8").strip()
OLDEST_TORCH = (2, 10)  # the first whose stable interface has all that csrc/torch calls
OLDEST_ARCHITECTURE = 75  # the oldest that CUDA 13 compiles for; see gs/gpu_forms.h
SEEDED_CUDA = (12, 9)  # the first whose nvcc knows -frandom-seed
COMMON_INCLUDE = Path(__file__).resolve().parent / "include"
SHARED_MODULES = Path(__file__).resolve().parent / "package"
# No -ffast-math: NaN, infinities and the order of sums matter. Nobody reads errno or traps.
CXX_FLAGS = ["-O3", "-std=c++17", "-Wall", "-Wextra", "-fno-math-errno", "-fno-trapping-math"]
CXX_FLAGS += [] if sys.platform == "win32" else ["-fPIC"]
# Symbols stay inside: the three libraries hold templates of the same names.
CXX_FLAGS += ["-fvisibility=hidden", "-fvisibility-inlines-hidden"]
X86_ISAS = {"baseline": [], "avx2": ["-march=x86-64-v3"], "avx512": ["-march=x86-64-v4", "-mprefer-vector-width=512"]}
ARM64_ISAS = {"baseline": ["-DGS_PLAIN", "-ffp-contract=off"], "neon": []}


def setup_extension(name: str, package: str, root: Path) -> None:
    """Runs setuptools for the extension in folder `root`: distribution `name`, import name `package`."""
    # There is no requirement on torch, since it would let pip replace the one that is there.
    setup(name=name, version=VERSION, license="Apache-2.0", **extension_options({package: Path(root)}))


def extension_options(roots: dict[str, Path]) -> dict[str, Any]:
    """setuptools' options for extensions, each an import name and its folder, which the running setup.py is above."""
    here, packages = Path.cwd(), []
    for package, root in roots.items():
        packages += find_packages(str(root), include=[package, f"{package}.*"])
    return {
        "python_requires": ">=3.10",
        "packages": packages,
        "package_dir": {package: os.path.relpath(root / package, here) for package, root in roots.items()},
        # The real source lists are found by the builder; setuptools only needs to know that there are libraries.
        "ext_modules": [Extension(f"{package}._backend", sources=[]) for package in roots],
        "cmdclass": {"build_ext": type("BuildBackends", (BuildBackends,), {"roots": roots}), "build_py": BuildModules},
        "options": {"bdist_wheel": {"py_limited_api": "cp310"}},
        "zip_safe": False,
    }


class BuildModules(build_py):
    """Copies the packages' modules, after removing those that an earlier build of the same folder has left.

    Each extension's package gets a copy of the modules that all share, since each package stands alone.
    """

    def run(self) -> None:
        """Copy the modules of all packages, and into each extension's package also those that all share."""
        for package in self.packages or []:
            for stale in (Path(self.build_lib) / package.replace(".", "/")).glob("*.py"):
                stale.unlink()
        super().run()
        for package in self.packages or []:
            for module in SHARED_MODULES.glob("*.py") if "." not in package else ():
                shutil.copy(module, Path(self.build_lib) / package)


class Compilation(NamedTuple):
    """A compiler's command without its input and output, which follow."""

    command: list[str]
    source: Path
    output: Path


class BuildBackends(build_ext):
    """Compiles csrc/ of each extension into one shared library."""

    roots: dict[str, Path]

    def get_ext_filename(self, fullname: str) -> str:
        # No interpreter tag: the library never sees Python.
        return str(Path(*fullname.split(".")).with_suffix(".so"))

    def build_extensions(self) -> None:
        """Compile the sources of all extensions in parallel, and link one library for each."""
        # Compilers are not looked for in the current folder, for which an empty entry stands, too.
        os.environ["PATH"] = os.pathsep.join(filter(os.path.isabs, os.environ.get("PATH", "").split(os.pathsep)))
        torch, cxx = import_torch(), find_compiler()
        nvcc = find_nvcc(torch.version.cuda)
        plans = {}
        for ext in self.extensions:
            root = Path(self.roots[ext.name.partition(".")[0]]).resolve()
            objects = Path(self.build_temp).resolve() / ext.name
            objects.mkdir(parents=True, exist_ok=True)
            plans[ext.name] = compilations(torch, cxx, nvcc, root / "csrc", objects)
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(compile_one, [one for plan in plans.values() for one in plan]))
        for name, plan in plans.items():
            library = Path(self.get_ext_fullpath(name)).resolve()
            library.parent.mkdir(parents=True, exist_ok=True)
            link(torch, cxx, nvcc, [one.output for one in plan], library)


def compilations(torch: ModuleType, cxx: list[str], nvcc: str | None, csrc: Path, objects: Path) -> list[Compilation]:
    """List all compilations of one library.

    nvcc: path of nvcc; None for a build without CUDA.
    """
    headers = Path(torch.__file__).parent / "include"
    # Messages name files without the folders of this machine, so that every machine builds the same bytes.
    places = [f"-ffile-prefix-map={folder}={name}" for folder, name in ((csrc.parents[1], "."), (headers, "torch"))]
    compile_cxx = [*cxx, *CXX_FLAGS, *places, f"-I{csrc}", f"-I{COMMON_INCLUDE}"]
    isas = {"baseline": []}
    if platform.machine() in ("x86_64", "AMD64"):
        compile_cxx.append("-DGS_X86")
        isas = X86_ISAS
    elif platform.machine() in ("aarch64", "arm64", "ARM64"):
        compile_cxx.append("-DGS_ARM64")
        isas = ARM64_ISAS
    ops_flags = ["-isystem", str(headers)]
    ops_flags += [f"-DTORCH_TARGET_VERSION={target_version(OLDEST_TORCH)}"]
    kernels = find_sources(csrc, "cuda", ".cu") if nvcc else []
    if kernels:
        ops_flags += ["-DGS_CUDA", "-DUSE_CUDA", "-isystem", str(toolkit_root(nvcc) / "include")]

    ops = find_sources(csrc, "torch", ".cpp")
    plan = [Compilation([*compile_cxx, *ops_flags], source, objects / f"{source.stem}.torch.o") for source in ops]
    sources = find_sources(csrc, "cpu", ".cpp")
    # Sources that are compiled once round alike on every machine, so products are never fused (gs/rounded.h).
    once = [*compile_cxx, "-ffp-contract=off"]
    plan += [Compilation(once, source, objects / f"{source.stem}.o") for source in sources if not is_per_isa(source)]
    # Baseline first: if several objects have the same template of the standard library, the linker keeps
    # the first one, which must run on every machine.
    for isa, flags in isas.items():
        command = [*compile_cxx, *flags, f"-DGS_ISA={isa}"]
        per_isa = [source for source in sources if is_per_isa(source)]
        plan += [Compilation(command, source, objects / f"{source.stem}.{isa}.o") for source in per_isa]
    if kernels:
        compile_cuda = [nvcc, "-O3", "-std=c++17", "-Xcompiler", "-fPIC,-fvisibility=hidden"]
        at_hand = [torch.cuda.get_device_capability(k) for k in range(torch.cuda.device_count())]
        compile_cuda += [*architecture_flags(nvcc, at_hand), f"-I{csrc}", f"-I{COMMON_INCLUDE}"]
        # nvcc then names local symbols by the source's path and the seed, instead of by chance.
        compile_cuda.append("-objtemp")
        seeded = cuda_version(nvcc) >= SEEDED_CUDA
        for source in kernels:
            seed = [f"-frandom-seed={source.stem}"] if seeded else []
            plan.append(Compilation([*compile_cuda, *seed], source, objects / f"{source.stem}.cu.o"))
    return plan


def find_sources(csrc: Path, folder: str, ending: str) -> list[Path]:
    """List the sources below folders of a name, at any depth, sorted by file name.

    File names differ, because objects are named after them.
    """
    found = [path for path in csrc.rglob(f"*{ending}") if folder in path.relative_to(csrc).parts[:-1]]
    return sorted(found, key=lambda path: path.name)


def compile_one(compilation: Compilation) -> None:
    """Runs one command."""
    command, source, output = compilation
    run([*command, "-c", str(source), "-o", str(output)], output.parent)


def link(torch: ModuleType, cxx: list[str], nvcc: str | None, objects: list[Path], library: Path) -> None:
    """Links objects into a library."""
    # libtorch stands for its parts: that for CUDA, too, where there is one.
    libraries = [f"-L{Path(torch.__file__).parent / 'lib'}"]
    libraries += ["-Wl,--no-as-needed", "-ltorch", "-Wl,--as-needed"] if sys.platform == "linux" else ["-ltorch"]
    if nvcc:
        # Static: torch may have another version of the runtime, or none. Both share the GPU's primary context.
        toolkit = toolkit_root(nvcc)
        libraries += [f"-L{toolkit / 'lib64'}", f"-L{toolkit / 'lib'}", "-lcudart_static", "-ldl", "-lrt"]
    # The C++ library must be the one torch has loaded; it is named in full since some machines link only the static one
    # by default.
    libraries += ["-l:libstdc++.so.6"] if sys.platform == "linux" else []
    shared = ["-dynamiclib", "-undefined", "dynamic_lookup"] if sys.platform == "darwin" else ["-shared"]
    run([*cxx, *shared, *map(str, objects), *libraries, "-o", str(library)], objects[0].parent)


def target_version(version: tuple[int, int]) -> str:
    """The oldest torch that a library is to run with, as torch's stable headers take it."""
    return f"0x{version[0]:02x}{version[1]:02x}000000000000"


def is_per_isa(source: Path) -> bool:
    """Tell whether a source is compiled once per instruction set."""
    return source.stem.endswith("_isa")


def import_torch() -> ModuleType:
    """Import torch; end the build with one line if torch is missing or too old."""
    try:
        import torch
    except ImportError:
        fail("torch is not installed: run `pip install -r requirements.txt` first")
    if tuple(int(part) for part in torch.__version__.split(".")[:2]) < OLDEST_TORCH:
        fail("torch {} is too old: {}.{} or newer is needed".format(torch.__version__, *OLDEST_TORCH))
    return torch


def find_compiler() -> list[str]:
    """Return the C++ compiler's command: CXX, else c++, g++ or clang++ on PATH.

    On Windows only LLVM's clang++ will do: MSVC has no vectors like those of gs/simd.h, and GCC does not link with
    torch.
    """
    wanted = shlex.split(os.environ.get("CXX", ""))
    usual = [["clang++"]] if sys.platform == "win32" else [["c++"], ["g++"], ["clang++"]]
    for command in [wanted] if wanted else usual:
        if shutil.which(command[0]):
            return command
    what = f"the C++ compiler {wanted[0]} (CXX)" if wanted else "a C++ compiler"
    fail(f"{what} was not found: install g++ or clang++ (C++17), or name one in CXX")


def find_nvcc(torch_cuda: str | None) -> str | None:
    """nvcc if the CUDA backend is to be built, else None. `torch_cuda`: torch.version.cuda."""
    switch = os.environ.get("GS_CUDA", "")
    if switch not in ("", "0", "1"):
        fail(f"GS_CUDA must be 0 or 1, not {switch!r}")
    if switch == "0" or not (switch or torch_cuda):
        return None
    home = os.environ.get("CUDA_HOME")
    nvcc = shutil.which("nvcc", path=str(Path(home) / "bin") if home else None)
    if switch and not nvcc:
        place = f"in CUDA_HOME ({home})" if home else "on PATH"
        fail(f"GS_CUDA=1 but there is no nvcc {place}: install it, or unset GS_CUDA to build for the CPU only")
    if nvcc and not switch:
        major, _ = cuda_version(nvcc)
        if major > int(torch_cuda.split(".")[0]):
            fail(
                f"{nvcc} is of CUDA {major} but torch was built with CUDA {torch_cuda}, whose driver may be too "
                "old: set CUDA_HOME to a toolkit of that version, GS_CUDA=0 to build for the CPU only, or GS_CUDA=1 to "
                "build all the same"
            )
    return nvcc


def cuda_version(nvcc: str) -> tuple[int, int]:
    """The version of the toolkit, (13, 0) for example."""
    release = re.search(r"release (\d+)\.(\d+)", run([nvcc, "--version"]))
    return (int(release[1]), int(release[2])) if release else fail(f"{nvcc} does not tell its version: set CUDA_HOME")


def toolkit_root(nvcc: str) -> Path:
    """The toolkit's folder: CUDA_HOME, else what nvcc itself reports (PATH may hold only a wrapper of it)."""
    if os.environ.get("CUDA_HOME"):
        return Path(os.environ["CUDA_HOME"])
    report = subprocess.run([nvcc, "--dryrun", "-x", "cu", "-c", os.devnull], capture_output=True, text=True).stderr
    top = re.search(r"^#\$ TOP=(.+)$", report, re.MULTILINE)
    if not top:
        fail(f"{nvcc} does not say where its toolkit lies: set CUDA_HOME")
    return Path(top[1]).resolve()


def architecture_flags(nvcc: str, at_hand: list[tuple[int, int]]) -> list[str]:
    """nvcc's flags for TORCH_CUDA_ARCH_LIST, else for the compute capabilities at hand, else for what nvcc knows."""
    names = os.environ.get("TORCH_CUDA_ARCH_LIST", "").replace(";", " ").split()
    names = names or sorted({f"{major}.{minor}" for major, minor in at_hand})
    if not names:
        known = re.findall(r"^compute_(75|\d+0)$", run([nvcc, "--list-gpu-arch"]), re.MULTILINE)
        names = [f"{n // 10}.{n % 10}" for n in sorted(map(int, known)) if n >= OLDEST_ARCHITECTURE]
        names[-1] += "+PTX"
    flags = []
    for name in names:
        number = name.removesuffix("+PTX").replace(".", "")
        if int(re.sub(r"\D", "", number) or 0) < OLDEST_ARCHITECTURE:
            fail(
                f"the CUDA backend needs compute capability 7.5 or newer, not {name}: set TORCH_CUDA_ARCH_LIST to the "
                "GPUs to run on, or GS_CUDA=0 to build for the CPU only"
            )
        code = f"sm_{number},compute_{number}" if name.endswith("+PTX") else f"sm_{number}"
        flags.append(f"-gencode=arch=compute_{number},code=[{code}]")
    return flags


def run(command: list[str], folder: Path | None = None) -> str:
    """Runs a tool and returns its output; ends the build with that output if the tool fails."""
    done = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    if done.returncode:
        fail(f"{shlex.join(command)}\n{done.stdout}failed with status {done.returncode}")
    if done.stdout and folder:
        print(done.stdout, end="", file=sys.stderr)
    return done.stdout


def fail(message: str) -> NoReturn:
    """Ends the build with one line and no traceback."""
    raise SystemExit(f"error: {message}")
