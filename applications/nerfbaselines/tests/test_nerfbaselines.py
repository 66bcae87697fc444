"""The method of NerfBaselines: stepped, saved, resumed and rendered as its Trainer does, and its records of cameras.

A stand-in takes the place of the package, of which the method needs two names. The last test needs the package.
"""

import runpy
import sys
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from lenses import opencv_pixels

from applications.nerfbaselines.datasets import MODELS, scene_of, view_of
from arguments.launch import launch_options
from scene.readers.start_cloud import OWN_POINTS

pycolmap = pytest.importorskip("pycolmap")
SPEC = Path(__file__).resolve().parents[3] / "applications" / "nerfbaselines" / "spec.py"


class Cameras(SimpleNamespace):
    """Cameras in the form of NerfBaselines; those of a dataset are iterated."""

    def item(self):
        return self

    def __iter__(self):
        return (Cameras(**{name: values[i] for name, values in vars(self).items()}) for i in range(len(self.poses)))


def one_camera(model=0, distortion=()):
    sizes, intrinsics = np.array([64, 48]), np.array([50.0, 55.0, 33.0, 23.0])
    lens = {"camera_models": np.array(model), "distortion_parameters": np.array(distortion)}
    return lens | {"poses": np.eye(3, 4, dtype=np.float32), "intrinsics": intrinsics, "image_sizes": sizes}


def dataset(views=4):
    """Photos of a grey wall at a depth of 4 through a lens, with transparent columns where white is behind it."""
    one = one_camera(1, [0.05, 0.0, 0.0, 0.0])
    cameras = Cameras(**{name: np.stack([values] * views) for name, values in one.items()})
    cameras.poses[:, 0, 3] = np.linspace(-0.5, 0.5, views)
    photos = np.full((views, 48, 64, 4), 128, np.uint8)
    photos[..., 3] = 255
    photos[:, :, 40:, 3] = 0
    grid = np.stack(np.meshgrid(np.linspace(-2, 2, 12), np.linspace(-2, 2, 10), [4.0]), -1).reshape(-1, 3)
    paths = {"image_paths": [f"/data/{i}.png" for i in range(views)], "image_paths_root": "/data"}
    points = {"points3D_xyz": grid.astype(np.float32), "points3D_rgb": np.full(grid.shape, 128, np.uint8)}
    metadata = {"background_color": np.full(3, 255, np.uint8)}
    return {"cameras": cameras, "images": list(photos), "masks": None, "metadata": metadata, **paths, **points}


@pytest.fixture
def method(monkeypatch):
    """The class, with a stand-in for the package, which is torn down with the module."""
    stand_in = ModuleType("nerfbaselines")
    stand_in.Method = object
    stand_in.register = lambda spec: stand_in.__dict__.setdefault("specs", []).append(spec)
    monkeypatch.setitem(sys.modules, "nerfbaselines", stand_in)
    monkeypatch.delitem(sys.modules, "applications.nerfbaselines.method", raising=False)
    import applications.nerfbaselines.method as module

    yield module
    sys.modules.pop("applications.nerfbaselines.method", None)


def trained(method, steps, **more):
    made = method.GaussianSplatting(train_dataset=dataset(), config_overrides={"iterations": 40, **more})
    told = [made.train_iteration(step) for step in range(steps)]
    return made, told


@pytest.mark.parametrize("more", [{}, {"schedule": 20}])
def test_a_training_that_is_saved_and_resumed_ends_as_one_that_was_not(method, tmp_path, more):
    whole, told = trained(method, 40, **more)
    assert {*[*filter(None, told)][-1]} == {"loss", "num_gaussians"}
    assert whole.get_info()["hparams"]["white_background"]
    half, _ = trained(method, 20, **more)
    half.save(tmp_path / "half")
    resumed = method.GaussianSplatting(checkpoint=str(tmp_path / "half"), train_dataset=dataset())
    assert resumed.get_info()["loaded_step"] == 20
    for step in range(20, 40):
        resumed.train_iteration(step)
    views = [made.render(Cameras(**one_camera()))["color"] for made in (whole, resumed)]
    np.testing.assert_array_equal(*views)
    assert views[0].shape == (48, 64, 3) and views[0].dtype == np.float32
    assert views[0][:, 48:].mean() > 0.9  # nothing but the background is there


def test_a_loaded_model_renders_the_same_and_is_saved_as_the_same_files(method, tmp_path):
    made, _ = trained(method, 40, time_budget=0.5)
    made.save(tmp_path / "first")
    loaded = method.GaussianSplatting(checkpoint=str(tmp_path / "first"), config_overrides={"iterations": 40})
    assert loaded.train_iteration(40) == {} and loaded.get_info()["loaded_step"] == 40
    camera = Cameras(**one_camera(1, [0.1, 0.0, 0.0, 0.0]))
    np.testing.assert_array_equal(made.render(camera)["color"], loaded.render(camera)["color"])
    loaded.save(tmp_path / "second")
    for path in filter(Path.is_file, (tmp_path / "first").rglob("*")):
        assert path.read_bytes() == (tmp_path / "second" / path.relative_to(tmp_path / "first")).read_bytes()


@pytest.mark.parametrize("given", [
    ("keep_unseen", True), ("keep_unseen", "true"), ("options", "auto"), ("advise", True), ("resolution", 4),
    ("viewer", 8080), ("checkpoint_iterations", 7), ("start_checkpoint", "chkpnt7.pth"),
])  # fmt: skip
def test_options_that_nothing_would_follow_are_refused(method, given):
    with pytest.raises(method.UserError, match=f"--{given[0]} {given[1]} has no effect in NerfBaselines"):
        method.words_of(dict([given]))
    assert method.words_of({"keep_unseen": "False", "options": "given", "resolution": 1})


def test_every_launch_option_is_known_to_work_or_refused(method):
    works = {"debug_from", "plain_step", "no_curve", "quiet"}
    assert vars(launch_options()).keys() == works | {*vars(launch_options())} & {*method._FIXED, *method._LISTS}


def test_pixels_that_a_mask_leaves_out_do_not_count():
    counts = np.zeros((48, 64), bool)
    counts[:10] = True
    info = scene_of(dataset() | {"masks": [counts] * 4}, OWN_POINTS)
    view = info.train_cameras[0]
    assert view.ignore_alpha and view.native.radial[0] == 0.05
    np.testing.assert_array_equal(np.asarray(view.image)[..., 3], counts * 255)
    assert (np.asarray(view.image)[..., :3] == 128).all() and view.image_name == "0.png"
    assert len(info.point_cloud.points) == 120


@pytest.mark.parametrize("model", range(1, len(MODELS)))
def test_lenses_project_as_colmap(model):
    """NerfBaselines lists k1, k2, p1, p2, k3 ... k6, of which each model has some."""
    distortion = [0.1, -0.03, 0.002, -0.004, 0.01, 0.02, 0.003, -0.002]
    view = view_of(Cameras(**one_camera(model, distortion)))
    name, places = MODELS[model]
    params = [50.0, 55.0, 33.0, 23.0, *(distortion[place] for place in places)]
    camera = pycolmap.Camera(model=name, width=64, height=48, params=params)
    points = np.array([[0.1, 0.2, 1.0], [-0.4, 0.3, 1.2], [0.3, -0.3, 0.9]])
    np.testing.assert_allclose(opencv_pixels(view.native, points), camera.img_from_cam(points), atol=1e-9)


def test_the_spec_of_the_package_names_the_method_and_its_presets(method):
    runpy.run_path(str(SPEC))
    (spec,) = sys.modules["nerfbaselines"].specs
    assert spec["method_class"] == "applications.nerfbaselines.method:GaussianSplatting"
    for preset in spec["presets"].values():
        method.parse(method.words_of({k: v for k, v in preset.items() if not k.startswith("@")}))
    info = method.GaussianSplatting.get_method_info()
    assert {*spec["supported_camera_models"]} == info["supported_camera_models"]


@pytest.mark.skipif(find_spec("nerfbaselines") is None, reason="nerfbaselines is not installed")
def test_the_package_has_the_interface_that_the_method_follows(monkeypatch):
    import nerfbaselines

    monkeypatch.setenv("NERFBASELINES_REGISTER", str(SPEC))
    spec = nerfbaselines.get_method_spec("gaussian-splatting-apache")
    with nerfbaselines.build_method_class(spec, "python") as made:
        assert isinstance(made.get_method_info(), dict) and issubclass(made, nerfbaselines.Method)
    names = ["pinhole", "opencv", "opencv_fisheye", "full_opencv"]
    assert [nerfbaselines.camera_model_to_int(name) for name in names] == [0, 1, 2, 3]
