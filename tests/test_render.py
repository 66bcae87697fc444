"""render.py: its files for a view, and its timing; test_end_to_end.py tests the whole command."""

import math
import shutil
from argparse import ArgumentParser, Namespace
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, rasterize
from gaussians import model
from PIL import Image

from arguments import ModelParams, PipelineParams
from gaussian_renderer.camera_paths import without_scene
from groundwork.files.image_files import read_plane, to_bytes
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from scene.gaussians.attributes import attributes
from scene.gaussians.ply import write_ply
from scene.saved_model import load_saved
from splatting.records.renders import INCOMPLETE
from utils.system_utils import UserError

render = pytest.importorskip("render", reason="the extensions are not built: make test")


FORMAT = "Namespace(sh_degree=3, source_path={!r}, eval={}, white_background={})"


def read(path) -> np.ndarray:
    with Image.open(path) as image:
        assert image.mode == "RGB"
        return np.asarray(image)


def view(target: torch.Tensor) -> SimpleNamespace:
    size = {"image_width": target.shape[2], "image_height": target.shape[1]}
    return SimpleNamespace(target=lambda background: target, counted_pixels=None, **size)


def names(folder: Path, pattern: str = "*.png") -> list[str]:
    return sorted(file.relative_to(folder).as_posix() for file in folder.rglob(pattern))


@pytest.fixture
def rendered(monkeypatch) -> dict[int, torch.Tensor]:
    """Stand-in results of render(), by view."""
    prepared: dict[int, torch.Tensor] = {}
    monkeypatch.setattr("gaussian_renderer.scored_views.render", lambda view, *_, **__: {"render": prepared[id(view)]})
    return prepared


@pytest.fixture
def folder(tmp_path, colmap_scene) -> Path:
    """A model folder with five Gaussians at iteration 7."""
    rows = {name: torch.zeros(5, *attribute.shape) for name, attribute in attributes(3).items()}
    write_ply(tmp_path / "model" / "point_cloud" / "iteration_7" / "point_cloud.ply", rows, 3)
    (tmp_path / "model" / "cfg_args").write_text(FORMAT.format(str(colmap_scene), True, False))
    return tmp_path / "model"


@pytest.fixture
def run(folder, monkeypatch) -> Callable[..., None]:
    """Runs render.py on that model in this process."""

    def command(*words: str) -> None:
        monkeypatch.setattr("sys.argv", ["render.py", "-m", str(folder), *words])
        render.main()

    return command


def test_bytes_are_rounded_half_up_and_clamped():
    values = torch.tensor([-76.5, 0, 0.499, 0.5, 1.5, 2.5, 254.5, 255, 1785], dtype=torch.float64) / 255
    assert to_bytes(values.repeat(3, 2, 1))[1, :, 2].tolist() == [0, 0, 0, 1, 2, 3, 255, 255, 255]
    levels = torch.arange(256, dtype=torch.float32).repeat(3, 1, 1) / 255  # every 8-bit value survives float32
    assert torch.equal(to_bytes(levels)[0, :, 0], torch.arange(256, dtype=torch.uint8))


def test_renders_and_ground_truth_side_by_side_in_the_place_of_earlier_ones(tmp_path, rendered, capsys):
    generator = torch.Generator().manual_seed(1)
    plain = torch.randint(0, 256, (3, 6, 8), dtype=torch.uint8, generator=generator)
    composited, first, second = torch.rand(3, 3, 6, 8, generator=generator)
    views = [view(plain), view(composited)]
    rendered.update({id(views[0]): first, id(views[1]): second})
    folder = tmp_path / "test" / "ours_7"

    def write(count: int) -> list[float]:
        return render.write_views(folder, views[:count], None, Namespace(), torch.zeros(3))

    assert write(0) == [] and not folder.parent.exists()
    with pytest.raises(KeyError):  # as if it was interrupted
        render.write_views(folder, [view(plain)], None, Namespace(), torch.zeros(3))
    assert (folder / INCOMPLETE).is_file()
    assert len(write(2)) == 2 and not (folder / INCOMPLETE).exists()
    assert names(folder) == ["gt/00000.png", "gt/00001.png", "renders/00000.png", "renders/00001.png"]
    for name, image in (("renders/00000", first), ("renders/00001", second), ("gt/00001", composited)):
        assert np.array_equal(read(folder / f"{name}.png"), to_bytes(image).numpy())
    assert np.array_equal(read(folder / "gt" / "00000.png"), plain.numpy().transpose(1, 2, 0))
    (folder / "gt" / "notes.png").write_text("mine")
    write(1)
    assert names(folder) == ["gt/00000.png", "gt/notes.png", "renders/00000.png"]
    capsys.readouterr()
    assert write(0) == [] and names(folder) == ["gt/notes.png"]
    assert capsys.readouterr().err == ""  # no progress bar without views


def test_a_model_without_gaussians_is_refused(folder, run):
    rows = {name: torch.zeros(0, *attribute.shape) for name, attribute in attributes(3).items()}
    write_ply(folder / "point_cloud" / "iteration_7" / "point_cloud.ply", rows, 3)
    with pytest.raises(UserError, match="iteration 7 of .* has no Gaussians"):
        run()
    assert sorted(path.name for path in folder.iterdir()) == ["cfg_args", "point_cloud"]


def test_sets_by_the_references_arguments(folder, colmap_scene, monkeypatch, capsys):
    shutil.copytree(folder / "point_cloud" / "iteration_7", folder / "point_cloud" / "iteration_30")
    parser = ArgumentParser()
    options, pipeline = ModelParams(parser), PipelineParams(parser)
    args = parser.parse_args(["-s", str(colmap_scene), "-m", str(folder), "--eval"])
    dataset = options.extract(args)
    before = vars(dataset).copy()

    def written() -> Counter:
        return Counter(name.split("/renders/")[0] for name in names(folder) if "/renders/" in name)

    assert render.render_sets(dataset, 7, pipeline.extract(args), True, False) is None
    assert written() == {"test/ours_7": 3}
    assert "warning" not in capsys.readouterr().err
    monkeypatch.setattr(without_scene, "have_moved", lambda *_: True)
    render.render_sets(dataset, -1, pipeline.extract(args), False, True, False)
    assert written() == {"test/ours_7": 3, "train/ours_30": 14}
    assert "warning: the scene's poses are not those that" in capsys.readouterr().err
    assert vars(dataset) == before


@pytest.mark.parametrize(("white", "words"), [(False, ["-w"]), (False, []), (True, []), (True, ["-w"])])
def test_a_model_trained_on_black_is_not_rendered_on_white_without_a_word(
    folder, run, colmap_scene, capsys, white, words
):
    (folder / "cfg_args").write_text(FORMAT.format(str(colmap_scene), True, white))
    run("--skip_train", "--skip_test", *words)
    said = capsys.readouterr().err
    warned = "has a black background in its cfg_args, but -w asks for white; leave -w out" in said
    assert warned == (words == ["-w"] and not white) and bool(said) == warned


def test_another_scene_is_rendered_only_where_that_is_said(folder, run, colmap_scene, tmp_path):
    other = Path(shutil.copytree(colmap_scene, tmp_path / "other"))
    with pytest.raises(UserError, match=f"of another scene, {colmap_scene}; leave -s out, or give --allow_"):
        run("-s", str(other), "--skip_train")
    assert not (folder / "test").exists()
    run("-s", str(other), "--skip_train", "--allow_other_scene")
    assert [path.name for path in (folder / "test").iterdir()] == ["ours_7_other"]
    shutil.move(colmap_scene, tmp_path / "moved")  # is no other scene
    run("-s", str(tmp_path / "moved"), "--skip_train")
    assert (folder / "test" / "ours_7").is_dir()


@pytest.mark.parametrize(
    ("words", "mark"),
    [(("-r", "2"), "_r2"), (("-r", "-1"), ""), (("-w",), "_white_background"), (("--antialiasing",), "_antialiasing"),
     (("--projection", "ray", "-r", "2"), "_projection_ray_r2"), (("--appearance", "ppisp"), ""),
     (("-i", "images/a"), "_images_images-a"), (("--mask_meaning", "ignore"), "_mask_meaning_ignore"), ((), "")],
)  # fmt: skip
def test_folders_are_named_after_options_that_are_not_the_models(folder, run, colmap_scene, words, mark):
    if "-i" in words:
        shutil.copytree(colmap_scene / "images", colmap_scene / "images" / "a")
    (method := folder / "test" / "ours_7").mkdir(parents=True)
    run("--skip_train", *words)
    written = [path.name for path in (folder / "test").iterdir() if (path / "gt" / "00000.png").is_file()]
    assert f"ours_7{mark}" in written and method.exists() and ("ours_7" in written) == (not mark)


def _rasterized(view: Camera, gaussians: GaussianModel) -> dict[str, np.ndarray]:
    """Inverse depth and alpha of a view, straight from the rasterizer."""
    settings = GaussianRasterizationSettings(
        view.image_height, view.image_width, math.tan(view.FoVx / 2), math.tan(view.FoVy / 2), torch.zeros(3), 1.0,
        view.world_view_transform, view.full_proj_transform, 3, view.camera_center, False, False, False,
    )  # fmt: skip
    with torch.no_grad():
        drawn = rasterize(
            gaussians.get_xyz, torch.zeros_like(gaussians.get_xyz), gaussians.get_opacity, settings,
            scales=gaussians.get_scaling, rotations=gaussians.get_rotation, sh_dc=gaussians.get_features_dc,
            sh_rest=gaussians.get_features_rest, want_inverse_depth=True, want_transmittance=True,
        )  # fmt: skip
    return {"depth": drawn.inverse_depth[0].numpy(), "alpha": 1 - drawn.transmittance[0].numpy()}


def test_depth_and_alpha_are_written_on_request_as_the_rasterizer_drew_them(folder, run, colmap_scene):
    gaussians = model(60, seed=3)
    gaussians.save_ply(str(folder / "point_cloud" / "iteration_7" / "point_cloud.ply"))

    def counts(*words: str) -> list[int]:
        run("--quiet", *words)
        return [len(list((folder / "test" / "ours_7" / plane).glob("*"))) for plane in ("depth", "alpha")]

    asked = (), ("--depth",), ("--alpha",), ("--depth", "--alpha")
    assert [counts(*words) for words in asked] == [[0, 0], [3, 0], [0, 3], [3, 3]]
    options = Namespace(source_path=str(colmap_scene), model_path=str(folder), eval=True)
    scene = load_saved(ModelParams(ArgumentParser()).extract(options), 7)
    for name, views in (("train", scene.getTrainCameras()), ("test", scene.getTestCameras())):
        for index, view in enumerate(views):
            for plane, expected in _rasterized(view, gaussians).items():
                file = folder / name / "ours_7" / plane / f"{index:05d}.png"
                with Image.open(file) as image:
                    assert image.mode == "I;16" and image.size == (view.image_width, view.image_height)
                    scale = float(image.text["scale"])
                largest = expected.max()
                assert scale == (1 / 65535 if plane == "alpha" else pytest.approx(largest / 65535, rel=1e-5))
                # Half a step, and the rasterizer's roundings.
                np.testing.assert_allclose(read_plane(file), expected, rtol=0, atol=0.5001 * scale + 1e-6 * largest)
                assert largest > 0.1
