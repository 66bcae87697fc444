"""Builds a torch extension with a CPU backend and, once it has csrc/cuda/*.cu, a CUDA one.

Each extension's setup.py calls `setup_extension`; pip does the rest. The result is <package>/_backend.so, which
registers its operators when torch.ops.load_library loads it. setuptools' own extension builder and torch's know
neither several instruction sets of one source nor parallel compilation without ninja, so this runs the commands.

The library uses torch's stable interface alone, so that it runs with every torch from OLDEST_TORCH on, and a torch
without CUDA is enough to build CUDA kernels.

Environment: CXX (compiler), CUDA_HOME (toolkit), GS_CUDA=0|1 (never, or always, build CUDA; unset: where nvcc is
found and torch was built with CUDA), TORCH_CUDA_ARCH_LIST ("9.0" or "8.0;9.0+PTX"; unset: those of the GPUs that are
visible, or with none all major ones from 8.0).
"""

import importlib.metadata
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

from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext
from setuptools.command.build_py import build_py

VERSION = (Path(__file__).resolve().parents[2] / "version.txt").read_text(encoding="utf-8").strip()
BUILT_FOR = "built-for"  # the extra that tells doctor.py which torch an extension was built for
OLDEST_TORCH = (2, 10)  # the first whose stable interface has all that csrc/torch calls
OLDEST_ARCHITECTURE = 80  # reductions over a warp in one instruction
COMMON_INCLUDE = Path(__file__).resolve().parent / "include"
# No -ffast-math: NaN, infinities and the order of sums matter. Nobody reads errno or traps.
CXX_FLAGS = ["-O3", "-std=c++17", "-fPIC", "-Wall", "-Wextra", "-fno-math-errno", "-fno-trapping-math"]
# Symbols stay inside: the three libraries hold templates of the same names.
CXX_FLAGS += ["-fvisibility=hidden", "-fvisibility-inlines-hidden"]
X86_ISAS = {"baseline": [], "avx2": ["-march=x86-64-v3"], "avx512": ["-march=x86-64-v4", "-mprefer-vector-width=512"]}


def setup_extension(name: str, package: str, root: Path) -> None:
    """Runs setuptools for the extension in folder `root`: distribution `name`, import name `package`."""
    setup(
        name=name,
        version=VERSION,
        license="Apache-2.0",
        python_requires=">=3.10",
        packages=find_packages(str(root), include=[package, f"{package}.*"]),
        # A requirement on torch would let pip replace the one that is there, and an extra is not installed unasked.
        extras_require={BUILT_FOR: [torch_requirement()]},
        # The real source list is found by the builder; setuptools only needs to know that there is a library.
        ext_modules=[Extension(f"{package}._backend", sources=[])],
        cmdclass={
            "build_ext": type("BuildBackend", (BuildBackend,), {"root": Path(root).resolve()}),
            "build_py": BuildModules,
        },
        zip_safe=False,
    )


class BuildModules(build_py):
    """Copies the package's modules, after removing those that an earlier build of the same folder has left."""

    def run(self) -> None:
        for package in self.packages or []:
            for stale in (Path(self.build_lib) / package.replace(".", "/")).glob("*.py"):
                stale.unlink()
        super().run()


def torch_requirement() -> str:
    """The torch that an extension works with, only the minor version that it was built against, as pip writes it."""
    try:
        major, minor = importlib.metadata.version("torch").split(".")[:2]
    except importlib.metadata.PackageNotFoundError:
        return "torch>={}.{}".format(*OLDEST_TORCH)
    return f"torch=={major}.{minor}.*"


class BuildBackend(build_ext):
    """Compiles csrc/ of the extension in `root` into one shared library."""

    root: Path

    def get_ext_filename(self, fullname: str) -> str:
        # No interpreter tag: the library never sees Python.
        return str(Path(*fullname.split(".")).with_suffix(".so"))

    def build_extension(self, ext: Extension) -> None:
        torch = import_torch()
        cxx = find_compiler()
        csrc = self.root / "csrc"
        kernels = sorted((csrc / "cuda").glob("*.cu"))
        nvcc = find_nvcc(torch.version.cuda) if kernels else None
        objects_dir = Path(self.build_temp).resolve() / ext.name
        objects_dir.mkdir(parents=True, exist_ok=True)
        library = Path(self.get_ext_fullpath(ext.name)).resolve()
        library.parent.mkdir(parents=True, exist_ok=True)

        compile_cxx = [*cxx, *CXX_FLAGS, f"-I{csrc}", f"-I{COMMON_INCLUDE}"]
        isas = {"baseline": []}
        if platform.machine() in ("x86_64", "AMD64"):
            compile_cxx.append("-DGS_X86")
            isas = X86_ISAS
        torch_dir = Path(torch.__file__).parent
        ops_flags = ["-isystem", str(torch_dir / "include"), f"-DTORCH_TARGET_VERSION={target_version(OLDEST_TORCH)}"]
        # libtorch stands for its parts: that for CUDA, too, where there is one.
        libraries = [f"-L{torch_dir / 'lib'}"]
        libraries += ["-Wl,--no-as-needed", "-ltorch", "-Wl,--as-needed"] if sys.platform == "linux" else ["-ltorch"]
        if nvcc:
            toolkit = toolkit_root(nvcc)
            ops_flags += ["-DGS_CUDA", "-DUSE_CUDA", "-isystem", str(toolkit / "include")]
            # Static: torch may have another version of the runtime, or none. Both share the GPU's primary context.
            libraries += [f"-L{toolkit / 'lib64'}", f"-L{toolkit / 'lib'}", "-lcudart_static", "-ldl", "-lrt"]

        ops = sorted((csrc / "torch").glob("*.cpp"))
        compilations = [([*compile_cxx, *ops_flags], source, f"{source.stem}.torch.o") for source in ops]
        sources = sorted((csrc / "cpu").glob("*.cpp"))
        # Sources that are compiled once round alike on every machine, so products are never fused (gs/rounded.h).
        once = [*compile_cxx, "-ffp-contract=off"]
        compilations += [(once, source, f"{source.stem}.o") for source in sources if not is_per_isa(source)]
        # Baseline first: if several objects have the same template of the standard library, the linker keeps
        # the first one, which must run on every machine.
        for isa, flags in isas.items():
            command = [*compile_cxx, *flags, f"-DGS_ISA={isa}"]
            compilations += [(command, source, f"{source.stem}.{isa}.o") for source in sources if is_per_isa(source)]
        if nvcc:
            compile_cuda = [nvcc, "-O3", "-std=c++17", "-Xcompiler", "-fPIC,-fvisibility=hidden"]
            at_hand = [torch.cuda.get_device_capability(k) for k in range(torch.cuda.device_count())]
            compile_cuda += architecture_flags(nvcc, at_hand)
            compile_cuda += [f"-I{csrc}", f"-I{COMMON_INCLUDE}"]
            compilations += [(compile_cuda, source, f"{source.stem}.cu.o") for source in kernels]
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            commands = [[*compiler, "-c", str(source), "-o", obj] for compiler, source, obj in compilations]
            list(pool.map(lambda command: run(command, objects_dir), commands))
        # Linked without -fopenmp: its runtime must be the one torch has loaded, not a second one. The same holds
        # for the C++ library, named in full since some machines link only the static one by default.
        libraries += ["-l:libstdc++.so.6"] if sys.platform == "linux" else []
        shared = ["-dynamiclib", "-undefined", "dynamic_lookup"] if sys.platform == "darwin" else ["-shared"]
        run([*cxx, *shared, *(obj for _, _, obj in compilations), *libraries, "-o", str(library)], objects_dir)


def target_version(version: tuple[int, int]) -> str:
    """The oldest torch that a library is to run with, as torch's stable headers take it."""
    return f"0x{version[0]:02x}{version[1]:02x}000000000000"


def is_per_isa(source: Path) -> bool:
    """Whether a source is compiled once per instruction set."""
    return source.stem.endswith("_isa")


def import_torch() -> ModuleType:
    """torch, new enough; otherwise ends the build with one line."""
    try:
        import torch
    except ImportError:
        fail("torch is not installed: run `pip install -r requirements.txt` first")
    if tuple(int(part) for part in torch.__version__.split(".")[:2]) < OLDEST_TORCH:
        fail("torch {} is too old: {}.{} or newer is needed".format(torch.__version__, *OLDEST_TORCH))
    return torch


def find_compiler() -> list[str]:
    """The C++ compiler's command: CXX, else c++, g++ or clang++ on PATH."""
    wanted = shlex.split(os.environ.get("CXX", ""))
    for command in [wanted] if wanted else [["c++"], ["g++"], ["clang++"]]:
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
        release = re.search(r"release (\d+)\.", run([nvcc, "--version"]))
        if release and int(release[1]) > int(torch_cuda.split(".")[0]):
            fail(
                f"{nvcc} is of CUDA {release[1]} but torch was built with CUDA {torch_cuda}, whose driver may be too "
                "old: set CUDA_HOME to a toolkit of that version, GS_CUDA=0 to build for the CPU only, or GS_CUDA=1 to "
                "build all the same"
            )
    return nvcc


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
        known = sorted(int(n) for n in re.findall(r"^compute_(\d+0)$", run([nvcc, "--list-gpu-arch"]), re.MULTILINE))
        names = [f"{n // 10}.0" for n in known if n >= OLDEST_ARCHITECTURE]
        names[-1] += "+PTX"
    flags = []
    for name in names:
        number = name.removesuffix("+PTX").replace(".", "")
        if int(re.sub(r"\D", "", number) or 0) < OLDEST_ARCHITECTURE:
            fail(
                f"the CUDA backend needs compute capability 8.0 or newer, not {name}: set TORCH_CUDA_ARCH_LIST to the "
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


def fail(message: str) -> None:
    """Ends the build with one line and no traceback."""
    raise SystemExit(f"error: {message}")
