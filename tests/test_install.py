"""Installation: the extensions' builder and its messages, and the root's wheel."""

import ctypes
import fnmatch
import importlib.util
import os
import platform
import re
import runpy
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

ROOT = Path(__file__).resolve().parent.parent
COMMON = ROOT / "submodules" / "common"
PACKAGES = ("diff_gaussian_rasterization", "fused_ssim", "simple_knn")


def load(name: str) -> ModuleType:
    """Load a module of submodules/common, which is on no path."""
    spec = importlib.util.spec_from_file_location(name, COMMON / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def builder(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    for name in ("CXX", "CUDA_HOME", "GS_CUDA", "TORCH_CUDA_ARCH_LIST"):
        monkeypatch.delenv(name, raising=False)
    return load("build_extension")


def fake_nvcc(folder: Path, release: str = "13.0") -> Path:
    """A toolkit folder whose nvcc answers --version, --list-gpu-arch and --dryrun like the real one."""
    nvcc = folder / "bin" / "nvcc"
    nvcc.parent.mkdir(parents=True)
    nvcc.write_text(
        f'#!/bin/sh\nif [ "$1" = --version ]; then echo "Cuda compilation tools, release {release}, V{release}.1"\n'
        'elif [ "$1" = --list-gpu-arch ]; then printf "compute_%s\\n" 70 75 80 86 90 100 103 120\n'
        f"else echo '#$ _HERE_={folder}/bin' >&2; echo '#$ TOP={folder}/bin/..' >&2; fi\n"
    )
    nvcc.chmod(0o755)
    return nvcc


def test_torch_that_does_not_serve(builder, monkeypatch):
    for installed, words in {
        None: "torch is not installed: run `pip install -r requirements.txt` first$",
        "2.9.1+cpu": r"torch 2.9.1\+cpu is too old: 2.10 or newer is needed$",
    }.items():
        monkeypatch.setitem(sys.modules, "torch", installed and SimpleNamespace(__version__=installed))
        with pytest.raises(SystemExit, match=f"^error: {words}"):
            builder.import_torch()


def test_missing_compiler(builder, monkeypatch, tmp_path):
    assert builder.find_compiler()
    monkeypatch.setenv("CXX", "no-such-ccache g++")
    with pytest.raises(SystemExit, match=r"^error: the C\+\+ compiler no-such-ccache \(CXX\) was not found: install"):
        builder.find_compiler()
    monkeypatch.delenv("CXX")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SystemExit, match=r"^error: a C\+\+ compiler was not found: install g\+\+ or clang\+\+"):
        builder.find_compiler()


FOUND, HERE, ELSEWHERE = "found", {"CUDA_HOME": "cuda"}, {"CUDA_HOME": "nothing"}


@pytest.mark.parametrize(
    ("environment", "release", "of_torch", "expected"),
    [
        (HERE, "13.0", "13.0", FOUND),
        (HERE, "13.0", None, None),
        (ELSEWHERE, "13.0", "13.0", None),
        (HERE | {"GS_CUDA": "0"}, "13.0", "13.0", None),
        (ELSEWHERE | {"GS_CUDA": "1"}, "13.0", "13.0", "GS_CUDA=1 but there is no nvcc in CUDA_HOME"),
        ({"PATH": "nothing", "GS_CUDA": "1"}, "13.0", "13.0", "GS_CUDA=1 but there is no nvcc on PATH"),
        (HERE | {"GS_CUDA": "1"}, "13.0", None, FOUND),
        (HERE | {"GS_CUDA": "1"}, "13.0", "12.8", FOUND),
        (HERE, "13.2", "12.8", "nvcc is of CUDA 13 but torch was built with CUDA 12.8, whose driver may"),
        (HERE, "13.2", "13.0", FOUND),
        (HERE, "13.2", "14.0", FOUND),
        ({"GS_CUDA": "yes"}, "13.0", "13.0", "GS_CUDA must be 0 or 1, not 'yes'$"),
    ],
)
def test_variables_and_torchs_own_cuda_decide(environment, release, of_torch, expected, builder, monkeypatch, tmp_path):
    """A visible GPU does not."""
    nvcc = str(fake_nvcc(tmp_path / "cuda", release))
    monkeypatch.setenv("PATH", "/bin:/usr/bin")
    for name, value in environment.items():
        monkeypatch.setenv(name, value if name == "GS_CUDA" else str(tmp_path / value))
    if expected in (FOUND, None):
        assert builder.find_nvcc(of_torch) == (nvcc if expected else None)
        return
    with pytest.raises(SystemExit, match=f"^error: .*{expected}"):
        builder.find_nvcc(of_torch)


def test_architectures(builder, monkeypatch, tmp_path):
    nvcc = str(fake_nvcc(tmp_path))

    def flags(*names: str, and_ptx: str) -> list[str]:
        last = [f"-gencode=arch=compute_{and_ptx},code=[sm_{and_ptx},compute_{and_ptx}]"] if and_ptx else []
        return [f"-gencode=arch=compute_{n},code=[sm_{n}]" for n in names] + last

    assert builder.architecture_flags(nvcc, []) == flags("75", "80", "90", "100", and_ptx="120")
    assert builder.architecture_flags(nvcc, [(9, 0), (7, 5), (9, 0)]) == flags("75", "90", and_ptx="")
    with pytest.raises(SystemExit, match="^error: the CUDA backend needs compute capability 7.5 or newer, not 7.0"):
        builder.architecture_flags(nvcc, [(7, 0)])
    monkeypatch.setenv("TORCH_CUDA_ARCH_LIST", "8.6;9.0a+PTX")
    assert builder.architecture_flags(nvcc, [(12, 0)]) == flags("86", and_ptx="90a")


def write_extension(folder: Path, kernel: str) -> None:
    """A tiny extension whose ops.cpp includes no torch, so that it compiles quickly."""
    (folder / "toy").mkdir()
    (folder / "toy" / "__init__.py").touch()
    (folder / "csrc" / "cpu").mkdir(parents=True)
    (folder / "csrc" / "cpu" / "kernel_isa.cpp").write_text(kernel)
    (folder / "csrc" / "torch").mkdir()
    (folder / "csrc" / "torch" / "ops.cpp").write_text("")
    (folder / "setup.py").write_text(
        f"import sys\nfrom pathlib import Path\nsys.path.insert(0, {str(COMMON)!r})\n"
        "from build_extension import setup_extension\n"
        "setup_extension(name='toy', package='toy', root=Path(__file__).parent)\n"
    )


def build_extension(folder: Path) -> subprocess.CompletedProcess:
    command = [sys.executable, "setup.py", "-q", "build_ext", "--inplace"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True)


KERNEL = """
    #define NAME_(name, isa) name##_##isa
    #define NAME(name, isa) NAME_(name, isa)
    extern "C" __attribute__((visibility("default"))) const char* NAME(place, GS_ISA)() { return __FILE__; }
    extern "C" __attribute__((visibility("default"))) int NAME(lanes, GS_ISA)() {
    #if defined(__AVX512F__)
      return 16;
    #elif defined(__AVX2__)
      return 8;
    #elif defined(__aarch64__) && !defined(GS_PLAIN)
      return 5;  // as wide as the baseline
    #else
      return 4;
    #endif
    }"""
LANES = {"x86_64": {"avx2": 8, "avx512": 16}, "aarch64": {"neon": 5}}
LANES |= {"AMD64": LANES["x86_64"], "arm64": LANES["aarch64"]}


def wheel_of(folder: Path) -> tuple[str, list[str], list[str]]:
    """Build the wheel of a folder by setuptools' backend: its name, the names in it, what its metadata requires."""
    code = "from setuptools import build_meta; print(build_meta.build_wheel('.'))"
    env = os.environ | {"PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, env=env)
    assert done.returncode == 0, done.stderr
    name = done.stdout.splitlines()[-1]
    with zipfile.ZipFile(folder / name) as wheel:
        names = wheel.namelist()
        metadata = wheel.read(next(name for name in names if name.endswith("/METADATA"))).decode()
    lines = metadata.splitlines()
    return name, names, [line.partition(": ")[2] for line in lines if line.startswith("Requires-Dist: ")]


@pytest.mark.slow
def test_a_build_has_every_instruction_set_and_the_same_bytes_wherever_it_is_made(tmp_path: Path) -> None:
    """Its wheel serves every Python, and leaves torch alone: pip --force-reinstall would install requirements again."""
    folders = [tmp_path / name / "toy" for name in ("one", "another_one")]
    for folder in folders:
        folder.mkdir(parents=True)
        write_extension(folder, KERNEL)
    done = build_extension(folders[0])
    assert done.returncode == 0, done.stderr
    name, names, requires = wheel_of(folders[1])
    assert "-cp310-abi3-" in name and "toy/_backend.so" in names and requires == []
    path = folders[0] / "toy" / "_backend.so"
    with zipfile.ZipFile(folders[1] / name) as wheel:
        assert wheel.read("toy/_backend.so") == path.read_bytes()
    library = ctypes.CDLL(str(path))
    library.place_baseline.restype = ctypes.c_char_p
    assert library.place_baseline() == b"./toy/csrc/cpu/kernel_isa.cpp"
    for isa, lanes in {"baseline": 4, **LANES.get(platform.machine(), {})}.items():
        assert library[f"lanes_{isa}"]() == lanes


def copy_modules(package: str, folder: Path) -> None:
    """Copy an extension's modules, and those that all share, as its build does."""
    source = ROOT / "submodules" / package.replace("_", "-") / package
    shutil.copytree(source, folder / package, ignore=shutil.ignore_patterns("*.so", "__pycache__"))
    for shared in (COMMON / "package").glob("*.py"):
        shutil.copy(shared, folder / package)


def last_line(statement: str, folder: Path) -> str:
    """The error in which a statement ends in the repository if modules of a folder are found first."""
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-B", "-c", statement]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=env)
    assert done.returncode == 1
    return done.stderr.splitlines()[-1]


@pytest.mark.parametrize("package", PACKAGES)
def test_an_extension_without_torch_says_what_to_do(package: str, tmp_path: Path) -> None:
    copy_modules(package, tmp_path)
    remedy = f"install it, then run `pip install ./submodules/{package.replace('_', '-')}` in the repository"
    torch_py = tmp_path / "torch.py"
    torch_py.write_text("raise ModuleNotFoundError(\"No module named 'torch'\", name='torch')")
    assert last_line(f"import {package}", tmp_path) == f"ImportError: {package} needs torch: {remedy}"
    torch_py.write_text("import part_of_torch")
    assert last_line(f"import {package}", tmp_path) == "ModuleNotFoundError: No module named 'part_of_torch'"


def copy_repository(folder: Path) -> None:
    """Copy what the repository's own build needs, with tiny extensions, and other packages, which must stay out."""
    for name in ("setup.py", "pyproject.toml", "requirements.txt", "version.txt"):
        shutil.copy(ROOT / name, folder)
    shutil.copytree(COMMON, folder / "submodules" / "common")
    for package in PACKAGES:
        extension = folder / "submodules" / package.replace("_", "-")
        extension.mkdir()
        write_extension(extension, "")
        (extension / "toy").rename(extension / package)
    for package in ("utils", "scene"):  # setuptools would find these by itself
        (folder / package).mkdir()
        (folder / package / "__init__.py").touch()
    (folder / "train.py").touch()


@pytest.mark.slow
def test_the_root_wheel_has_the_extensions_alone(tmp_path: Path) -> None:
    copy_repository(tmp_path)
    name, names, requires = wheel_of(tmp_path)
    assert name.startswith("gaussian_splatting-") and "-cp310-abi3-" in name
    files = ["__init__.py", "_backend.so", *(path.name for path in (COMMON / "package").glob("*.py"))]
    parts = {f"{package}/{file}" for package in PACKAGES for file in files}
    assert {name for name in names if ".dist-info/" not in name} == parts
    # The installed torch stays.
    assert "torch<2.14,>=2.10" in requires and "torchvision" in requires
    assert any(requirement.startswith("numpy==") for requirement in requires)


def test_the_sdist_has_all_that_is_tracked() -> None:
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if tracked.returncode:
        pytest.skip("not a checkout of git")
    manifest = (ROOT / "MANIFEST.in").read_text()
    grafted = re.findall(r"^graft (\S+)$", manifest, re.MULTILINE)
    included = [*re.search(r"^include (.+)$", manifest, re.MULTILINE)[1].split(), "MANIFEST.in", "pyproject.toml"]
    for name in tracked.stdout.splitlines():
        folder, _, inner = name.partition("/")
        taken = folder in grafted if inner else any(fnmatch.fnmatch(name, pattern) for pattern in included)
        assert taken or name in (".gitignore", ".gitattributes"), name


def test_other_platforms_take_the_flags_of_the_builder(builder: ModuleType) -> None:
    cross = runpy.run_path(str(ROOT / ".ci" / "cross.py"))
    assert {isa: list(flags) for isa, flags in cross["ARM64"].items()} == builder.ARM64_ISAS
    unneeded = {"-fPIC", "-fvisibility=hidden", "-fvisibility-inlines-hidden"}
    assert set(cross["FLAGS"]) - {"-Werror", "-pthread"} == set(builder.CXX_FLAGS) - unneeded
