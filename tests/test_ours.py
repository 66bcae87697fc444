"""Nothing is run, replaced or deleted that is not ours (SECURITY.md)."""

import ast
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from test_house import ROOT, _module, _python, _tree

from applications.evaluation.stages import _remove_stop
from applications.export.sog import PROGRAM
from groundwork.files.ours import folder_digest, is_ours, write_picture
from groundwork.host.programs import find_program
from utils.system_utils import UserError

# The functions that look for, run or delete something, by the reason why they may.
MAY = {
    "the one place that looks for programs": "groundwork.host.programs.find_program",
    "runs what find_program found, such as npm and what that installs by a record of the repository": """
        groundwork.host.machine._run_program applications.doctor.environment._find_nvidia_gpu
        applications.convert.colmap._read_output applications.export.sog.find_fault
        applications.export.vendor._run_command applications.convert.programs._run_command
        gaussian_renderer.camera_paths.video.write_video""",
    "runs imageio-ffmpeg's ffmpeg, without relative entries of PATH": """applications.convert.video._warn_if_cut
        applications.convert.video._list_sdr_filters applications.convert.video.find_streams""",
    "runs sys.executable with files of this repository": """groundwork.host.machine.facts_from_process
        applications.doctor.advice._train applications.evaluation.child.run_child
        splatting.records.curve_recorder.begin""",
    "runs compilers, where BuildBackends left relative entries of PATH out, and empties setuptools' build folder": """
        submodules.common.build_extension.run submodules.common.build_extension.find_compiler
        submodules.common.build_extension.find_nvcc submodules.common.build_extension.toolkit_root""",
    "the scene's orientation, where there was none before the page wrote it": """
        applications.viewer.measure_tab._write_records""",
    "a folder that is_ours, and that no other JSON file names": "applications.export.side_files._remove_folder",
    "a picture that is_ours, below `input`": "applications.convert.video.remove_frames",
    "what this process itself has just made, or files with names of atomic_write, whose process has ended": """
        applications.export.side_files.write_with_folder applications.export.streamed.write_lod_meta
        applications.demo.make_scene.make_scene applications.nerfbaselines.method._begin_training
        groundwork.files.writing.atomic_write groundwork.files.writing.check_folder_can_be_made
        groundwork.files.folders.locked groundwork.files.folders.remove_temporary_files""",
    "numbered renders, or a reserved name in a model folder, which a training or a rendering makes anew": """
        groundwork.files.image_files.remove_leftovers splatting.commands.render.write_views
        splatting.commands.render.render_set splatting.commands.render.render_sets
        splatting.records.error_curve.continue_curve applications.evaluation.stages._remove_stop splatting.run.open
        splatting.resume.__init__ splatting.resume.ended splatting.resume._may_continue
        splatting.features.robust_mask_residuals.write_masks gaussian_renderer.camera_paths.render_path.render_path""",
    "a reserved name in `distorted`, or in a scene that convert.py has made; refuse_foreign_results knows": """
        applications.convert.adding.forget_base applications.convert.adding.keep_base
        applications.convert.mapping.map_photos applications.convert.colmap.copy_database
        applications.convert.stages._remove_paths""",
}
CALLS = {"rmtree", "unlink", "rmdir", "which", "Popen", "check_call", "check_output", "system", "removedirs"}
OF_MODULES = {("subprocess", "run"), ("subprocess", "call"), ("os", "remove"), ("os", "popen"), ("torch", "load")}


def _calls(tree: ast.AST, owner: str) -> set[str]:
    """The functions that make such calls, or that name such a function for another one to call."""
    found = set()
    for node in ast.iter_child_nodes(tree):
        inside = node.name if isinstance(node, ast.FunctionDef) else owner
        named = isinstance(node, ast.Attribute) and (getattr(node.value, "id", ""), node.attr)
        if named and (node.attr in CALLS or named in OF_MODULES):
            found.add(owner)
        if not isinstance(node, ast.arg | ast.AnnAssign):  # which name types
            found |= _calls(node, inside)
    return found


def test_few_functions_run_or_delete_anything_and_each_has_a_reason():
    """But for benchmarks, which write into folders of their own."""
    files = [path for path in _python() if path.relative_to(ROOT).parts[0] != "benchmarks"]
    found = {f"{_module(path)}.{name}" for path in files for name in _calls(_tree(path), "")}
    assert sorted(found) == sorted(name for names in MAY.values() for name in names.split())


def test_pictures_are_opened_in_one_place():
    """That place knows the formats that Pillow decodes itself. Pillow passes PostScript to another program."""
    for path in _python():
        if path.relative_to(ROOT).parts[0] != "benchmarks" and path.name != "image_files.py":
            assert "Image.open(" not in path.read_text(encoding="utf-8"), path


@pytest.fixture
def trap(tmp_path, monkeypatch) -> Path:
    """The current folder, which has programs of all names; each leaves a trace."""
    for folder in (tmp_path, tmp_path / "node_modules" / ".bin"):
        folder.mkdir(parents=True, exist_ok=True)
        for name in (PROGRAM, "ffmpeg", "colmap", "npm", "git", "nvidia-smi", "node"):
            (folder / name).write_text(f"#!/bin/sh\ntouch {tmp_path}/trace\n")
            (folder / name).chmod(0o755)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("path", ["/nowhere", ".", "", ":/nowhere", "/nowhere:", "node_modules/.bin:.:/nowhere"])
def test_programs_of_the_current_folder_are_not_found(trap, monkeypatch, path):
    monkeypatch.setenv("PATH", path)
    assert not any(map(find_program, (PROGRAM, "ffmpeg", "colmap", "npm", "nvidia-smi")))
    assert all(map(os.path.isabs, filter(None, os.environ["PATH"].split(os.pathsep))))
    assert find_program("./colmap") == str(trap / "colmap")  # which a user has named
    monkeypatch.setenv("PATH", f"relative:{trap}")
    assert find_program("colmap") == str(trap / "colmap")


@pytest.mark.parametrize(
    "words",
    [
        ("export.py", "a.sog", "--to", "b.ply"),
        ("convert.py", "-s", "scene", "--colmap_executable", "colmap", "--video", "a.mp4"),
    ],
)
@pytest.mark.slow
def test_commands_run_nothing_of_the_current_folder(trap, words):
    (trap / "a.sog").write_bytes(b"PK")
    (trap / "a.mp4").write_bytes(b"no video")
    (trap / "scene" / "input").mkdir(parents=True)
    environment = os.environ | {"PATH": f":.:node_modules/.bin:{os.environ['PATH']}"}
    subprocess.run([sys.executable, str(ROOT / words[0]), *words[1:]], env=environment, capture_output=True)
    assert not (trap / "trace").exists()


@pytest.mark.parametrize("name", ["a.png", "a.html.jpg"])
def test_pictures_are_known_until_somebody_changes_them(tmp_path, name):
    path, noise = tmp_path / name, np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    write_picture(path, Image.fromarray(noise))
    ours = path.read_bytes()
    with Image.open(path) as image:
        image.load()  # a comment is no damage
        assert image.size == (30, 20) and is_ours(path)
        write_picture(path, image.convert("RGB").rotate(90))  # ours may be replaced
        assert is_ours(path)
        for foreign in (b"", b"\xff\xd8", b"my notes", ours[:-1], ours[:-20] + b"x" * 20, None):
            path.unlink()
            if foreign is None:
                (tmp_path / "elsewhere").write_bytes(ours)
                path.symlink_to(tmp_path / "elsewhere")
            else:
                path.write_bytes(foreign)
            assert not is_ours(path)
            with pytest.raises(
                UserError, match=f"no export wrote .*{name} as it is.*; move it, or choose another --to"
            ):
                write_picture(path, image.convert("RGB"))
            assert path.is_symlink() or path.read_bytes() == foreign


def test_a_folder_is_ours_by_its_files_and_its_owner(tmp_path):
    folder = tmp_path / "made"
    (folder / "deep").mkdir(parents=True)
    (folder / "deep" / "a").write_text("a")
    named = folder.rename(tmp_path / f"tiles-{folder_digest(folder, 'a.json')}")
    assert is_ours(named, "a.json") and not is_ours(named, "b.json")
    (named / "deep" / "mine").touch()
    assert not is_ours(named, "a.json")


def test_a_record_of_others_leads_to_no_other_folder(tmp_path):
    model, photos = tmp_path / "model", tmp_path / "photos"
    (model / "point_cloud" / "iteration_1").mkdir(parents=True)
    photos.mkdir()
    for iteration in ("1/../../../photos", [1], None, 1):
        _remove_stop(SimpleNamespace(model=model, options=()), iteration)
    assert photos.is_dir() and not any((model / "point_cloud").iterdir())


def test_figures_go_by_no_settings_of_the_current_folder(tmp_path):
    pytest.importorskip("matplotlib")
    (tmp_path / "matplotlibrc").write_text("text.usetex: True\n")
    code = "from splatting.records.figures import make_figure\nfrom matplotlib import rcParams\n"
    code += "assert rcParams['text.usetex']\nmake_figure(1, (2, 2), '')\nassert not rcParams['text.usetex']"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, check=True)
