"""GitHub's workflows and the scripts in .ci: every step exists here, and every action is a fixed commit."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
SCRIPTS = sorted(path for path in (ROOT / ".ci").iterdir() if path.suffix == "")
HIDDEN = {"-fvisibility=hidden", "-fvisibility-inlines-hidden"}
TEXT = "\n".join(path.read_text(encoding="utf-8") for path in WORKFLOWS)


def _steps(text: str) -> list[str]:
    return re.findall(r"^\s+(?:- )?run: (.+)$", text, re.MULTILINE)


def _wrong(step: str) -> str | None:
    """What is wrong with a step: it must be one target of make, or one script of .ci."""
    if made := re.fullmatch(r"make ([\w-]+)", step):
        phony = re.search(r"^\.PHONY: (.+)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
        return None if made[1] in phony[1].split() else f"no target {made[1]}"
    if script := re.fullmatch(r"(python )?(\.ci/[\w.]+)((?: [\w.-]+| \"?\$\S+| \$\{\{ [\w.]+ \}\})*)", step):
        path = ROOT / script[2]
        if not path.is_file():
            return f"no script {script[2]}"
        return None if script[1] or os.access(path, os.X_OK) else f"{script[2]} is not executable"
    return "logic outside of make and .ci"


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_steps_are_targets_and_scripts_that_exist(path):
    text = path.read_text(encoding="utf-8")
    steps = _steps(text)
    assert steps and len(steps) == len(re.findall(r"\brun:", text))
    assert {step: wrong for step in steps if (wrong := _wrong(step))} == {}


@pytest.mark.parametrize(
    "step", ["make no-such", ".ci/none", "python .ci/none.py", "make test && rm x", "pip install x"]
)
def test_a_wrong_step_is_seen(step):
    assert _wrong(step)


def test_actions_are_fixed_commits_and_rights_are_few():
    used = re.findall(r"uses: (\S+)", TEXT)
    assert len(used) > 10
    assert [action for action in used if not re.fullmatch(r"actions/[\w-]+@[0-9a-f]{40}", action)] == []
    for path in WORKFLOWS:
        assert "\npermissions:\n  contents: read\n" in path.read_text(encoding="utf-8"), path
    assert TEXT.count("persist-credentials: false") == TEXT.count("actions/checkout@")
    assert re.findall(r"\$\{\{ (?:github\.event|github\.head_ref)", TEXT) == []  # text of strangers


def test_every_platform_and_product_has_a_job():
    for system in ("ubuntu-24.04\n", "ubuntu-24.04-arm", "windows-", "macos-"):
        assert system in TEXT
    wanted = {
        "make lint",
        "make test",
        "make test-browser",
        "make test-foreign",
        "make docs",
        "make wheels",
        "make gate",
    }
    assert wanted <= set(_steps(TEXT))
    kinds = re.search(r"file: \[(.+)\]", TEXT)[1].split(", ")
    assert sorted(kinds) == sorted(path.name.split(".")[0] for path in (ROOT / "docker").glob("*.Dockerfile"))


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows_are_yaml(path):
    yaml = pytest.importorskip("yaml", reason="PyYAML is not installed")
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert {"name", "jobs", "permissions", True} <= content.keys()  # YAML 1.1 reads the key `on` as a truth value
    for job in content["jobs"].values():
        assert job["timeout-minutes"] <= 120 and job["runs-on"] and job["steps"]
        for step in job["steps"]:
            assert ("run" in step) != ("uses" in step)


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
    sources = {str(path.relative_to(ROOT)) for path in ROOT.glob("submodules/*/csrc/cuda/*.cu")}
    assert len(sources) > 10
    for architecture in ("sm_80", "sm_90"):
        compiled = [re.search(r"-c (\S+)", call)[1] for call in calls if f"-arch={architecture} " in call]
        assert sorted(compiled) == sorted(sources)
    nvcc.write_text("#!/bin/sh\nexit 1\n")
    assert subprocess.run([ROOT / ".ci" / "compile_cuda"], env=environment, capture_output=True).returncode != 0


def test_emulated_platforms_take_the_builders_flags():
    cross, builder = (_loaded(ROOT / path) for path in (".ci/cross.py", "submodules/common/build_extension.py"))
    assert {isa: list(flags) for isa, flags in cross.ARM64.items()} == builder.ARM64_ISAS
    assert set(cross.FLAGS) - {"-Werror", "-pthread"} == set(builder.CXX_FLAGS) - {"-fPIC"} - HIDDEN
    assert {path.stem for name in cross.EXTENSIONS for path in cross.tests(name)} == {
        path.stem for path in ROOT.glob("submodules/*/csrc/tests/**/*.cpp") if "emulated" not in path.stem
    }
    offered = re.search(r"platform: \[(.+)\]", TEXT)[1].split(", ")
    assert sorted(offered) == sorted(cross.TARGETS)


def _loaded(path: Path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = sys.modules[path.stem] = importlib.util.module_from_spec(spec)  # where dataclasses look for it
    spec.loader.exec_module(module)
    return module


def test_tests_without_make_install_the_same():
    module = _loaded(ROOT / ".ci" / "test_without_make.py")
    made = re.search(r"^EXTENSIONS := (.+)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert list(module.EXTENSIONS) == made[1].split()
    first, *built, tests = module.commands(Path("python"), ["-x"])
    assert first[-1] == "requirements-dev.txt" and (ROOT / first[-1]).is_file()
    assert [line[-1] for line in built] == [f"./submodules/{name}" for name in made[1].split()]
    assert tests[-1] == "-x" and "not browser" in tests
