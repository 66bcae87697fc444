"""Workflows, the scripts in .ci, and Dockerfiles: what they name exists here, and versions are fixed."""

import fnmatch
import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from test_house import COMMANDS, ROOMS

ROOT = Path(__file__).resolve().parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
SCRIPTS = sorted(path for path in (ROOT / ".ci").iterdir() if path.suffix == "")
DOCKERFILES = sorted((ROOT / "docker").glob("*.Dockerfile"))
TEXT = "\n".join(path.read_text(encoding="utf-8") for path in WORKFLOWS)
STEPS = re.findall(r"^\s+(?:- )?run: (.+)$", TEXT, re.MULTILINE)
EXTENSIONS = ["simple-knn", "fused-ssim", "diff-gaussian-rasterization"]


def _loaded(path: Path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = sys.modules[path.stem] = importlib.util.module_from_spec(spec)  # where dataclasses look for it
    spec.loader.exec_module(module)
    return module


def _wrong(step: str) -> bool:
    """Whether a step is neither one target of make nor one script of .ci."""
    if made := re.fullmatch(r"make ([\w-]+)", step):
        phony = re.search(r"^\.PHONY: (.+)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
        return made[1] not in phony[1].split()
    script = re.fullmatch(r"(python )?(\.ci/[\w.]+)((?: [\w.-]+| \"?\$\S+| \$\{\{ [\w.]+ \}\})*)", step)
    return not script or not (ROOT / script[2]).is_file() or not (script[1] or os.access(ROOT / script[2], os.X_OK))


def test_steps_are_targets_and_scripts_that_exist():
    assert len(STEPS) == len(re.findall(r"\brun:", TEXT)) > 10
    assert [step for step in STEPS if _wrong(step)] == []
    wrong = ["make no-such", ".ci/none", "python .ci/none.py", "make test && rm x", "pip install x"]
    assert all(map(_wrong, wrong))
    needed = {f"make {name}" for name in ("lint", "test", "test-browser", "test-foreign", "docs", "wheels", "gate")}
    assert needed <= set(STEPS)
    assert all(system in TEXT for system in ("ubuntu-24.04\n", "ubuntu-24.04-arm", "windows-", "macos-"))
    kinds = re.search(r"file: \[(.+)\]", TEXT)[1].split(", ")
    assert sorted(kinds) == sorted(path.name.split(".")[0] for path in DOCKERFILES)


def test_actions_are_fixed_commits_and_rights_are_few():
    used = re.findall(r"uses: (\S+)", TEXT)
    assert len(used) > 10
    assert [action for action in used if not re.fullmatch(r"actions/[\w-]+@[0-9a-f]{40}", action)] == []
    for path in WORKFLOWS:
        assert "\npermissions:\n  contents: read\n" in path.read_text(encoding="utf-8"), path
    assert TEXT.count("persist-credentials: false") == TEXT.count("actions/checkout@")
    assert re.findall(r"\$\{\{ (?:github\.event|github\.head_ref)", TEXT) == []  # text of strangers


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows_are_yaml(path):
    yaml = pytest.importorskip("yaml", reason="PyYAML is not installed")
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert {"name", "jobs", "permissions", True} <= content.keys()  # YAML 1.1 reads the key `on` as a truth value
    for job in content["jobs"].values():
        assert job["timeout-minutes"] <= 120 and job["runs-on"]
        assert all(("run" in step) != ("uses" in step) for step in job["steps"])


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.name)
def test_scripts_are_sound_shell(path):
    text = path.read_text(encoding="utf-8")
    assert text.startswith("#!/usr/bin/env bash\n#") and "\nset -euo pipefail\n" in text and os.access(path, os.X_OK)
    assert subprocess.run(["bash", "-n", path]).returncode == 0
    named = re.findall(r"(?:^|\s)(\.ci/\w+(?:\.py)?)", re.sub(r"^#.*", "", text, flags=re.MULTILINE))
    assert [name for name in named if not (ROOT / name).is_file()] == []


def test_cuda_sources_are_all_compiled(tmp_path):
    """A compiler that only writes down what it is told."""
    nvcc = tmp_path / "nvcc"
    nvcc.write_text(f'#!/bin/sh\necho "$@" >> {tmp_path}/calls\n')
    nvcc.chmod(0o755)
    environment = os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}"}
    subprocess.run([ROOT / ".ci" / "compile_cuda", "sm_80", "sm_90"], env=environment, check=True, capture_output=True)
    calls = (tmp_path / "calls").read_text().splitlines()
    sources = sorted(str(path.relative_to(ROOT)) for path in ROOT.glob("submodules/*/csrc/cuda/*.cu"))
    assert len(sources) > 10
    for architecture in ("sm_80", "sm_90"):
        compiled = [re.search(r"-c (\S+)", call)[1] for call in calls if f"-arch={architecture} " in call]
        assert sorted(compiled) == sources
    nvcc.write_text("#!/bin/sh\nexit 1\n")
    assert subprocess.run([ROOT / ".ci" / "compile_cuda"], env=environment, capture_output=True).returncode != 0


def test_other_platforms_take_the_flags_and_extensions_of_make():
    cross, builder = (_loaded(ROOT / path) for path in (".ci/cross.py", "submodules/common/build_extension.py"))
    assert {isa: list(flags) for isa, flags in cross.ARM64.items()} == builder.ARM64_ISAS
    unneeded = {"-fPIC", "-fvisibility=hidden", "-fvisibility-inlines-hidden"}
    assert set(cross.FLAGS) - {"-Werror", "-pthread"} == set(builder.CXX_FLAGS) - unneeded
    assert {path.stem for name in cross.EXTENSIONS for path in cross.tests(name)} == {
        path.stem for path in ROOT.glob("submodules/*/csrc/tests/**/*.cpp") if "emulated" not in path.stem
    }
    assert sorted(re.search(r"platform: \[(.+)\]", TEXT)[1].split(", ")) == sorted(cross.TARGETS)
    module = _loaded(ROOT / ".ci" / "test_without_make.py")
    assert f"\nEXTENSIONS := {' '.join(module.EXTENSIONS)}\n" in (ROOT / "Makefile").read_text()
    first, *built, tests = module.commands(Path("python"), ["-x"])
    assert first[-1] == "requirements-dev.txt" and (ROOT / first[-1]).is_file()
    assert [line[-1] for line in built] == [f"./submodules/{name}" for name in EXTENSIONS]
    assert tests[-1] == "-x" and "not browser" in tests


RULES = [line for line in (ROOT / ".dockerignore").read_text().splitlines() if line and line[0] != "#"]


def _taken(path: str) -> bool:
    """Whether Docker sends a path of the repository: the last rule that fits it, or a folder above it, decides."""
    above = ["/".join(path.split("/")[: k + 1]) for k in range(path.count("/") + 1)]
    taken = True
    for rule in RULES:
        pattern = rule.removeprefix("!").removeprefix("**/")
        names = above if not rule.startswith("**/") else path.split("/")
        if any(fnmatch.fnmatchcase(name, pattern) and name.count("/") == pattern.count("/") for name in names):
            taken = rule.startswith("!")
    return taken


@pytest.fixture(scope="module")
def context(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What Docker sends to a build, from the files of a clone."""
    folder = tmp_path_factory.mktemp("context")
    rooms = [name for name in (rule.removeprefix("!") for rule in RULES) if (ROOT / name).is_dir()]
    files = [path for room in rooms for path in (ROOT / room).rglob("*") if path.is_file()]
    for path in (*files, *filter(Path.is_file, ROOT.iterdir())):
        name = path.relative_to(ROOT).as_posix()
        if _taken(name):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, folder / name)
    return folder


def test_docker_gets_the_commands_and_their_rooms_and_is_ready(context):
    """Its doctor lacks no file, and its builder reads the version; compiling is not tried."""
    needed = {*ROOMS, "submodules", *(f"{name}.py" for name in COMMANDS), "requirements.txt", "version.txt", "LICENSE"}
    assert {path.name for path in context.iterdir()} == needed - {"benchmarks", "setup.py"}
    left_out = ("build", "__pycache__", "tests")
    assert not [path for path in context.rglob("*") if path.name in left_out or path.suffix in (".so", ".pyc")]
    assert sum(path.stat().st_size for path in context.rglob("*")) < 8 << 20
    said = {"capture_output": True, "text": True}
    done = subprocess.run([sys.executable, "-B", "doctor.py"], cwd=context, **said)
    problems = [line for line in done.stdout.splitlines() if "PROBLEM" in line and "from other sources" not in line]
    assert not problems and done.stderr == ""
    assert "agrees with its float64 oracle" in done.stdout and ("ready\n" in done.stdout) == (done.returncode == 0)
    folder = context / "submodules" / "simple-knn"
    done = subprocess.run([sys.executable, "-B", "setup.py", "--version"], cwd=folder, **said)
    assert done.stdout.splitlines()[-1:] == [(ROOT / "version.txt").read_text().strip()], done.stderr


@pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.stem)
def test_dockerfiles_copy_what_exists_and_images_are_small_and_without_rights(path, context):
    text = path.read_text(encoding="utf-8")
    copied = [words.split()[:-1] for words in re.findall(r"^COPY (?!--from)(.+)$", text, re.MULTILINE)]
    assert len(copied) >= 3 and all((context / source).exists() for sources in copied for source in sources)
    assert re.findall(r"\./submodules/([\w-]+)", text) == EXTENSIONS
    stages = re.findall(r"^FROM (\S+)(?: AS (\w+))?$", text, re.MULTILINE)
    assert [name for _, name in stages] == ["build", ""]
    assert all(re.search(r":\d", image) for image, _ in stages)  # a version, never `latest`
    last = text[text.rindex("\nFROM ") :]
    assert re.findall(r"^USER (.+)$", last, re.MULTILINE) == ["1000:1000"] and "g++" not in last
    assert text.count("apt-get install") == text.count("rm -rf /var/lib/apt/lists/*")
    pinned = re.search(r"^setuptools==.+$", (ROOT / "requirements-dev.txt").read_text(), re.MULTILINE)[0]
    assert f'"{pinned}"' in text
