"""convert.py --add: new photos beside those of a scene, which stay where they are."""

import contextlib
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from photo_room import camera_centers, make_photos
from PIL import Image

import convert
from splatting.sfm import stages
from splatting.sfm.adding import keep_base
from splatting.sfm.images import prepare_images
from splatting.sfm.layout import Layout, image_names
from utils.system_utils import UserError

PLACES = 10
LATER = ("photo_03.png", "photo_06.png")


def _scenes(folder: Path) -> None:
    """The photos of `all`, and a scene of those that are not LATER."""
    make_photos(folder / "all", PLACES)
    shutil.copytree(folder / "all", folder / "scene" / "input", ignore=shutil.ignore_patterns(*LATER))
    convert.main(["-s", str(folder / "scene"), "--no_gpu"])


@pytest.fixture
def room(once, tmp_path: Path) -> Path:
    """A copy, with `scene` and `all`."""
    return Path(shutil.copytree(once("room to add to", _scenes), tmp_path / "copy", copy_function=shutil.copy2))


def _run(scene: Path, *options: str) -> pycolmap.Reconstruction:
    convert.main(["-s", str(scene), "--no_gpu", *options])
    return pycolmap.Reconstruction(str(scene / "sparse" / "0"))


def _poses(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    return {image.name: image.cam_from_world().matrix() for image in model.images.values()}


def _put(room: Path, *names: str) -> None:
    for name in names:
        shutil.copy2(room / "all" / name, room / "scene" / "input")


@pytest.mark.slow
def test_old_photos_keep_poses_and_bytes_and_new_ones_are_placed(room, capsys):
    scene = room / "scene"
    before = pycolmap.Reconstruction(str(scene / "sparse" / "0"))
    pictures = {path.name: path.read_bytes() for path in (scene / "images").iterdir()}
    _run(scene, "--orient")
    _put(room, *LATER[:1])
    _run(scene, "--add")
    assert (scene / "orientation.json").is_file()  # asked for once
    assert f"added: 1 of 1 new photos; the {PLACES - 2} before keep their poses" in capsys.readouterr().out
    _put(room, *LATER[1:])
    model = _run(scene, "--add")
    assert f"added: 1 of 1 new photos; the {PLACES - 1} before keep their poses" in capsys.readouterr().out
    old, new = _poses(before), _poses(model)
    assert sorted(new) == sorted([*old, *LATER])
    assert max(np.abs(new[name] - pose).max() for name, pose in old.items()) < 1e-12
    assert {path.name: path.read_bytes() for path in (scene / "images").iterdir() if path.name in old} == pictures
    assert len(model.cameras) == 1 and model.cameras[1].params.tolist() == before.cameras[1].params.tolist()
    ransac = pycolmap.RANSACOptions()
    ransac.max_error = 0.05
    names, places = sorted(new), camera_centers(PLACES)
    at = [places[int(name[6:8])] for name in names]
    model.transform(pycolmap.align_reconstruction_to_locations(model, names, np.array(at), len(names), ransac))
    for name in LATER:
        where = model.find_image_with_name(name).projection_center()
        assert np.abs(where - places[int(name[6:8])]).max() < 0.04
    _run(scene, "--add")
    assert (
        "reused from an earlier run: photos, features, matching, mapping, undistortion, capture, orient"
        in capsys.readouterr().out
    )


def test_an_interrupted_run_keeps_what_it_adds_to_and_leaves_out_photos_of_another_place(room, monkeypatch, capsys):
    scene, old = room / "scene", _poses(pycolmap.Reconstruction(str(room / "scene" / "sparse" / "0")))
    _put(room, *LATER)
    noise = np.random.default_rng(0).integers(0, 255, (180, 240, 3), dtype=np.uint8)
    Image.fromarray(noise).save(scene / "input" / "elsewhere.png")
    with monkeypatch.context() as patch:
        patch.setattr(stages.report, "read_survey", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            _run(scene, "--add")
    new = _poses(_run(scene, "--add"))
    assert sorted(new) == sorted([*old, *LATER])
    assert "added: 2 of 3 new photos" in capsys.readouterr().out
    assert max(np.abs(new[name] - pose).max() for name, pose in old.items()) < 1e-12


def test_what_cannot_be_added_is_said(room, tmp_path, capsys):
    scene = room / "scene"
    with pytest.raises(UserError, match="no new photos"):
        _run(scene, "--add")
    with pytest.raises(UserError, match="--poses does not go with --add"):
        _run(scene, "--add", "--poses", str(scene / "sparse" / "0"))
    shutil.copytree(room / "all", tmp_path / "other" / "input")
    with pytest.raises(UserError, match="leave --add out"):
        _run(tmp_path / "other", "--add")
    _put(room, *LATER)
    (scene / "input" / "photo_00.png").unlink()
    with pytest.raises(UserError, match=r"lacks photo_00\.png; put them back"):
        _run(scene, "--add")
    _run(scene)
    assert "without --add, photos that were added before get new poses" in capsys.readouterr().err
    assert not (scene / "distorted" / "base").exists()


def test_photos_that_are_prepared_under_other_names_are_known(tmp_path):
    """By files of kinds that COLMAP does not read, or without a suffix; the model is not asked."""
    layout, names = Layout(tmp_path), ["a.webp", "b.jp2", "c", "d.avif", "e.png"]
    layout.input.mkdir()
    for name, kind in zip(names, ("WEBP", "JPEG2000", "TIFF", "AVIF", "PNG"), strict=True):
        Image.new("RGB", (32, 24)).save(layout.input / name, kind)
    prepare_images(layout, names, None)
    with pytest.raises(UserError, match="has no new photos"):
        keep_base(layout, True, names)
    layout.base.mkdir()
    with contextlib.closing(sqlite3.connect(layout.base_database)) as database:
        database.execute("CREATE TABLE images (name TEXT)")
        database.executemany("INSERT INTO images VALUES (?)", [(name,) for name in image_names(layout.prepared)])
        database.commit()
    keep_base(layout, False, [*names, "new.png"])
    with pytest.raises(UserError, match=r"lacks a\.webp; put them back"):
        keep_base(layout, False, names[1:])
