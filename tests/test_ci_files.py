"""Workflows, scripts in .ci, and Docker's files: faults that no linter of `make lint` and no job would notice."""

import os
import re
import subprocess
from pathlib import Path

from test_house import COMMANDS, ROOMS

ROOT = Path(__file__).resolve().parents[1]
TEXT = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / ".github" / "workflows").glob("*.yml"))


def test_steps_are_targets_of_make_and_scripts():
    steps = re.findall(r"\brun: (.+)$", TEXT, re.MULTILINE)
    assert len(steps) > 10
    phony = re.search(r"^\.PHONY: (.+)$", (ROOT / "Makefile").read_text(), re.MULTILINE)[1].split()
    for step in steps:
        first, second, *_ = [*step.split(), ""]
        script = ROOT / (second if first == "python" else first)
        if first == "make":
            assert step.split()[1:] == [second] and second in phony, step
        else:
            assert script.parent.name == ".ci" and script.is_file() and "&&" not in step, step
            assert first == "python" or os.access(script, os.X_OK), step


def test_actions_are_fixed_commits_and_rights_are_few():
    used = re.findall(r"uses: (\S+)", TEXT)
    assert len(used) > 10
    assert [action for action in used if not re.fullmatch(r"actions/[\w-]+@[0-9a-f]{40}", action)] == []
    assert TEXT.count("\npermissions:\n  contents: read\n") == TEXT.count("\njobs:\n")
    assert TEXT.count("persist-credentials: false") == TEXT.count("actions/checkout@")
    assert re.findall(r"\$\{\{ (?:github\.event|github\.head_ref)", TEXT) == []  # text of strangers


def test_cuda_sources_are_all_compiled(tmp_path):
    """A compiler that only writes down what it is told."""
    nvcc = tmp_path / "nvcc"
    nvcc.write_text(f'#!/bin/sh\necho "$@" >> {tmp_path}/calls\n')
    nvcc.chmod(0o755)
    environment = os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}"}
    subprocess.run([ROOT / ".ci" / "compile_cuda", "sm_80"], env=environment, check=True, capture_output=True)
    compiled = re.findall(r"-arch=sm_80 .*-c (\S+)", (tmp_path / "calls").read_text())
    sources = sorted(str(path.relative_to(ROOT)) for path in ROOT.glob("submodules/*/csrc/**/*.cu"))
    assert sorted(compiled) == sources and len(sources) > 10
    nvcc.write_text("#!/bin/sh\nexit 1\n")
    assert subprocess.run([ROOT / ".ci" / "compile_cuda"], env=environment, capture_output=True).returncode != 0


def test_docker_gets_the_commands_and_their_rooms():
    rules = (ROOT / ".dockerignore").read_text().splitlines()
    needed = {*ROOMS, *(f"{name}.py" for name in COMMANDS)} - {"benchmarks", "setup.py"}
    needed |= {"submodules", "requirements.txt", "version.txt", "LICENSE"}
    assert {rule[1:] for rule in rules if rule[:1] == "!"} == needed
