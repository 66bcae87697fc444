"""The images: what their Dockerfiles copy exists, suffices to be ready, and runs as nobody special."""

import fnmatch
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from test_house import COMMANDS, ROOMS

ROOT = Path(__file__).resolve().parents[1]
FILES = sorted((ROOT / "docker").glob("*.Dockerfile"))
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
    files += [path for path in ROOT.iterdir() if path.is_file()]
    for path in files:
        name = path.relative_to(ROOT).as_posix()
        if _taken(name):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, folder / name)
    return folder


def test_the_context_is_the_commands_and_their_rooms(context):
    wanted = {*ROOMS, "submodules", *(f"{name}.py" for name in COMMANDS), "requirements.txt", "version.txt", "LICENSE"}
    assert {path.name for path in context.iterdir()} == wanted - {"benchmarks", "setup.py"}
    unwanted = ("build", "__pycache__", "tests")
    assert not [path for path in context.rglob("*") if path.name in unwanted or path.suffix in (".so", ".pyc")]
    assert sum(path.stat().st_size for path in context.rglob("*")) < 8 << 20


def test_the_context_is_ready(context):
    """Its doctor lacks no file. Whether the extensions installed here are up to date is not the question."""
    done = subprocess.run([sys.executable, "-B", "doctor.py"], cwd=context, capture_output=True, text=True)
    problems = [line for line in done.stdout.splitlines() if "PROBLEM" in line and "from other sources" not in line]
    assert not problems and done.stderr == ""
    assert "agrees with its float64 oracle" in done.stdout and ("ready\n" in done.stdout) == (done.returncode == 0)


def test_the_context_builds_extensions(context):
    """The builder reads the version and the requirement on torch; compiling is not tried."""
    for name in ("simple-knn", "fused-ssim", "diff-gaussian-rasterization"):
        said = subprocess.run(
            [sys.executable, "-B", "setup.py", "--version"],
            cwd=context / "submodules" / name,
            capture_output=True,
            text=True,
        )
        assert said.stdout.splitlines()[-1:] == [(ROOT / "version.txt").read_text().strip()], said.stderr


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_dockerfiles_copy_what_exists(path, context):
    text = path.read_text(encoding="utf-8")
    copied = [words.split() for words in re.findall(r"^COPY (?!--from)(.+)$", text, re.MULTILINE)]
    assert len(copied) >= 3
    for *sources, _ in copied:
        assert [source for source in sources if not (context / source).exists()] == []
    for installed in re.findall(r"\./(submodules/[\w-]+)", text):
        assert (context / installed / "setup.py").is_file()
    assert len(re.findall(r"\./submodules/", text)) == 3


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_images_are_small_and_without_rights(path):
    text = path.read_text(encoding="utf-8")
    stages = re.findall(r"^FROM (\S+)(?: AS (\w+))?$", text, re.MULTILINE)
    assert [name for _, name in stages] == ["build", ""]
    assert all(re.search(r":\d", image) for image, _ in stages)  # a version, never `latest`
    last = text[text.rindex("\nFROM ") :]
    assert re.findall(r"^USER (.+)$", last, re.MULTILINE) == ["1000:1000"] and "g++" not in last
    assert text.count("apt-get install") == text.count("rm -rf /var/lib/apt/lists/*")
    pinned = re.search(r"^setuptools==.+$", (ROOT / "requirements-dev.txt").read_text(), re.MULTILINE)[0]
    assert f'"{pinned}"' in text
