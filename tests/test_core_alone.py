"""The core without applications and benchmarks, which may be deleted."""

import ast
import os
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

pytest.importorskip("diff_gaussian_rasterization", reason="the extensions are not built: make test")

ROOT = Path(__file__).resolve().parents[1]
DELETED = ("applications", "benchmarks")
LEFT_OUT = (".*", "build", "output", "node_modules", "__pycache__", "tests", "docs")
COMMANDS = {"convert": "convert", "doctor": "doctor", "export": "export", "full_eval": "evaluation", "view": "viewer"}


def _run(folder: Path, *words: object) -> subprocess.CompletedProcess:
    environment = os.environ | {"TORCH_HOME": os.devnull, "https_proxy": "http://127.0.0.1:9"}  # no weights of LPIPS
    environment.pop("PYTHONPATH", None)
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def alone(once) -> Path:
    """A copy of the code without DELETED."""

    def copy(folder: Path) -> None:
        ignored = shutil.ignore_patterns(*LEFT_OUT)
        shutil.copytree(ROOT, folder / "code", ignore=ignored)
        for name in DELETED:
            shutil.rmtree(folder / "code" / name, ignore_errors=True)

    return once("core_alone", copy) / "code"


def _results(code: Path, scene: Path, model: Path) -> dict[str, bytes]:
    """The model, its renders and its scores, by the commands of `code`."""
    short = "--iterations", 60, "--test_iterations", 60, "--densify_from_iter", 20, "--densification_interval", 20
    short += "--disable_viewer", "--eval", "--quiet"
    for line in (("train.py", "-s", scene, *short), ("render.py", "--skip_train"), ("metrics.py",)):
        done = _run(code, line[0], "-m", model, *line[1:])
        assert done.returncode == 0, done.stderr
    names = ("point_cloud.ply", "results.json", "per_view.json")
    found = [path for path in model.rglob("*") if path.name in names or path.parent.name == "renders"]
    return {str(path.relative_to(model)): path.read_bytes() for path in found}


@pytest.mark.slow
def test_training_rendering_and_scoring_have_the_same_bytes(alone, colmap_scene, tmp_path):
    whole = _results(ROOT, colmap_scene, tmp_path / "whole")
    assert len(whole) > 4 and _results(alone, colmap_scene, tmp_path / "alone") == whole


@pytest.mark.parametrize("command", COMMANDS)
def test_a_deleted_application_is_named(alone, command):
    done = _run(alone, f"{command}.py", "-h")
    folder = f"applications/{COMMANDS[command]}"
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"error: this needs {folder}, which is not there; restore that folder of the repository\n"


def test_photos_without_cameras_need_an_application(alone, tmp_path):
    (tmp_path / "a.jpg").touch()
    done = _run(alone, "train.py", "-s", tmp_path, "-m", tmp_path / "out")
    assert done.returncode == 2 and "this needs applications/convert" in done.stderr


@cache
def _imports(path: Path) -> tuple[set[str], set[Path]]:
    """Find the rooms of DELETED, and the helpers of tests, that a file imports outside of functions."""
    names, nodes = set(), [ast.parse(path.read_text(encoding="utf-8"))]
    for node in nodes:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        for_types = isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        nodes += [] if for_types or isinstance(node, ast.FunctionDef) else ast.iter_child_nodes(node)
    parts = [name.split(".") for name in names]
    rooms = {".".join(part[: 1 if part[0] == "benchmarks" else 2]) for part in parts if part[0] in DELETED}
    rooms |= {f"applications.{COMMANDS[part[0]]}" for part in parts if part[0] in COMMANDS}
    helpers = [part[1:] if part[0] == "tests" else part for part in parts]
    files = {ROOT.joinpath("tests", *part[:n]).with_suffix(".py") for part in helpers for n in (1, 2)}
    return rooms, {file for file in files if file.is_file()}


def test_a_test_is_left_out_with_each_application_that_it_imports(request):
    """conftest.py looks at a test and its helpers. That the core imports no application, tests/test_house.py checks."""
    rooms_of = request.config.pluginmanager.get_plugin(str(ROOT / "conftest.py"))._list_rooms
    for test in (*ROOT.glob("tests/**/test_*.py"), *ROOT.glob("applications/*/tests/test_*.py")):
        files, rooms = [test], set()
        for file in files:
            found, others = _imports(file)
            rooms |= found
            files += others - {*files}
        assert rooms <= rooms_of(test), test
