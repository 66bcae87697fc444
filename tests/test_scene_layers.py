"""The rooms of scene/ and utils/: which may import which, and what stays importable."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
OWN = ("arguments", "gaussian_renderer", "records", "scene", "training", "utils")

# Room: prefixes of the project's modules that it may import. The longest prefix of a module's name is its room.
ALLOWED = {
    "scene.pictures": ("scene.pictures", "utils"),
    "scene.readers": ("scene.readers", "scene.pictures", "utils"),
    "scene.gaussians": ("scene.gaussians", "utils"),
    "scene.gaussian_model": ("scene.gaussians", "scene.readers.records", "utils"),
    "scene.dataset_readers": ("scene.readers", "scene.pictures", "utils"),
    "scene.cameras": ("scene.readers.records", "scene.pictures", "utils"),
    "scene": ("scene", "arguments", "utils"),
    "utils.host": ("utils.host",),
    "utils.exact": ("utils.exact",),
    "utils.camera_utils": ("scene.cameras",),
    "utils.make_depth_scale": ("scene.readers.depth_scale", "utils"),
    "utils": ("utils",),
}
UTILS = {  # the reference's names, and what came with them
    *("camera_utils", "general_utils", "graphics_utils", "image_utils", "loss_utils", "make_depth_scale"),
    *("lpips_utils", "sh_utils", "system_utils", "view_scores"),
}


def _modules() -> Iterator[str]:
    for folder in ("scene", "utils"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            yield ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def _room(module: str) -> str:
    return max((room for room in ALLOWED if _within(module, room)), key=len)


def _within(module: str, room: str) -> bool:
    return module == room or module.startswith(room + ".")


def _imports(module: str) -> Iterator[str]:
    """The project's modules that a module imports; `from a import b` counts as a.b where that is a module."""
    path = ROOT / (module.replace(".", "/") + ".py")
    tree = ast.parse((path if path.is_file() else path.with_suffix("") / "__init__.py").read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            below = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if (ROOT / (name.replace(".", "/") + ".py")).is_file() else node.module for name in below]
        else:
            continue
        yield from (name for name in names if name.split(".")[0] in OWN)


@pytest.mark.parametrize("module", list(_modules()))
def test_a_module_imports_only_rooms_below_it(module):
    allowed = ALLOWED[_room(module)]
    wrong = [name for name in _imports(module) if not any(_within(name, prefix) for prefix in allowed)]
    assert not wrong, f"{module} imports {wrong}; it may import {allowed}"


def test_utils_has_the_names_of_the_reference_at_its_top():
    assert {path.stem for path in (ROOT / "utils").glob("*.py")} - {"__init__"} == UTILS


def _loaded(statement: str) -> list[str]:
    """The modules of scene that are loaded after a statement in a fresh process."""
    code = f"import sys\n{statement}\nprint(*(name for name in sys.modules if name.split('.')[0] == 'scene'))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_the_model_loads_no_reader_but_the_records():
    readers = [name for name in _loaded("import scene.gaussian_model") if name.startswith("scene.readers.")]
    assert readers == ["scene.readers.records"]
    assert _loaded("import scene") == ["scene"]


def test_what_users_import_is_there():
    code = """
from scene import GaussianModel, Scene, cameras
from scene.cameras import Camera, MiniCam
from scene.dataset_readers import CameraInfo, SceneInfo, sceneLoadTypeCallbacks
from scene.gaussian_model import GaussianModel as same
from utils.camera_utils import cameraList_from_camInfos, camera_to_JSON
from utils.system_utils import Terminated, compute_device, mkdir_p, searchForMaxIteration
assert same is GaussianModel and Scene.__module__ == "scene.scene" and cameras.Camera is Camera
"""
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)
    with pytest.raises(ImportError, match="no_such_name"):
        from scene import no_such_name  # noqa: F401


def test_private_tensors_are_read_inside_scene_alone():
    """`pc._opacity` and its like are the model's own; the renderer takes `raw_geometry()`."""
    private = {"_xyz", "_features_dc", "_features_rest", "_scaling", "_rotation", "_opacity"}
    for folder in ("arguments", "benchmarks", "diagnosis", "evaluation", "gaussian_renderer", "records", "training"):
        for path in (ROOT / folder).rglob("*.py"):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            found = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)} & private
            assert not found, f"{path.relative_to(ROOT)} reads {found}"
