"""The choice of the COLMAP model, the search for photos by name, and photos of every format in a scene."""

import os
import re
import shutil
import unicodedata
from pathlib import Path

import pycolmap
import pytest
from PIL import EpsImagePlugin, Image
from synthetic import HEIGHT, WIDTH, as_text, make_colmap_scene, read

from scene.images.find import find_images
from scene.images.masks import MaskOptions
from utils.system_utils import UserError


def _rename(scene: Path, new_names: dict[str, str], text: bool = False) -> None:
    """Rename photos in the model and on disk."""
    sparse = scene / "sparse" / "0"
    reconstruction = pycolmap.Reconstruction(str(sparse))
    for image in reconstruction.images.values():
        if image.name in new_names:
            new = new_names[image.name]
            (scene / "images" / new).parent.mkdir(parents=True, exist_ok=True)
            shutil.move(scene / "images" / image.name, scene / "images" / new)
            image.name = new
    reconstruction.write_binary(str(sparse))
    if text:
        as_text(scene)


def _model(folder: Path, views: int) -> None:
    """Write a model with the first few photos of the scene that contains the folder."""
    reconstruction = pycolmap.Reconstruction(str(folder.parent / "0"))
    for image_id in sorted(reconstruction.reg_image_ids())[views:]:
        reconstruction.deregister_frame(reconstruction.images[image_id].frame_id)
    folder.mkdir()
    reconstruction.write_binary(str(folder))


@pytest.mark.parametrize("text", [False, True])
def test_names_with_spaces_and_letters_of_all_sorts(colmap_scene, text):
    names = ["der Wald/Föhn  7 .png", "森/写真 1.png", "a b.png", "12 34.png"]
    olds = [camera.image_name for camera in read(colmap_scene).train_cameras]
    _rename(colmap_scene, dict(zip(olds, names, strict=False)), text)
    found = [camera.image_name for camera in read(colmap_scene).train_cameras]
    assert set(names) < set(found) and len(found) == 17


def test_names_that_match_but_for_case_accents_or_slashes(colmap_scene, capsys):
    olds = [camera.image_name for camera in read(colmap_scene).train_cameras]
    composed = unicodedata.normalize("NFC", "é.png")
    _rename(colmap_scene, {olds[0]: composed})
    pictures = colmap_scene / "images"
    (pictures / composed).rename(pictures / unicodedata.normalize("NFD", composed))
    (pictures / "RIGHT").mkdir()
    (pictures / olds[1]).rename(pictures / olds[1].upper())
    capsys.readouterr()
    cameras = {camera.image_name: camera.image_path for camera in read(colmap_scene).train_cameras}
    assert len(cameras) == 17 and all(path.is_file() for path in cameras.values())
    assert cameras[olds[1]].name == Path(olds[1]).name.upper()
    said = capsys.readouterr().err
    assert said.startswith("2 of 17 photos are matched to files whose names differ") and said.count("\n") == 1

    # Two similar names, neither of them the exact one: the reader must not guess.
    shutil.copyfile(pictures / olds[1].upper(), pictures / olds[1].upper().replace("PNG", "Png"))
    with pytest.raises(UserError, match="1 of 17 photos"):
        read(colmap_scene)


def test_photos_of_another_format_are_used_and_named(colmap_scene, capsys):
    first, second = [camera.image_path for camera in read(colmap_scene).train_cameras][:2]
    Image.open(first).save(first.with_suffix(".jpg"))
    first.unlink()
    capsys.readouterr()
    assert read(colmap_scene).train_cameras[0].image_path == first.with_suffix(".jpg")
    said = f"1 of 17 photos are matched to files whose names have another suffix .* is {first.stem}.jpg for "
    assert re.search(said.replace("is ", "is .*"), capsys.readouterr().err)

    # One file for two photos, or two files for one photo: the reader must not guess.
    assert find_images(first.parent, [f"{first.stem}.bmp"], "", "") == [first.with_suffix(".jpg")]
    with pytest.raises(UserError, match="2 of 2 photos"):
        find_images(first.parent, [first.name, f"{first.stem}.bmp"], "", "")
    second.unlink()
    with pytest.raises(UserError, match=f"1 of 17 photos .*{second.name}.* on without: .*colmap image_deleter --input"):
        read(colmap_scene)


@pytest.mark.parametrize("linked", ["images", "images/left", "masks"])
def test_names_differ_behind_a_link_too(colmap_scene, linked):
    """Folders that are links, also with one that leads back to the scene."""
    for path in (colmap_scene / "images").rglob("*.png"):
        mask = (colmap_scene / "masks" / path.relative_to(colmap_scene / "images")).with_suffix(".PNG")
        mask.parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (WIDTH, HEIGHT), 255).save(mask)
    for path in (colmap_scene / "images/left").iterdir():
        path.rename(path.with_suffix(".PNG"))
    (colmap_scene / "images/left/loop").symlink_to(colmap_scene)
    (colmap_scene / "store").mkdir()
    target = (colmap_scene / linked).rename(colmap_scene / "store" / "photos")
    (colmap_scene / linked).symlink_to(target)
    views = read(colmap_scene, masks=MaskOptions("masks")).train_cameras
    assert len(views) == 17 and all(view.mask for view in views)


def test_the_largest_of_several_models(colmap_scene, capsys):
    whole = read(colmap_scene)
    assert capsys.readouterr().err == ""
    sparse = colmap_scene / "sparse"
    _model(sparse / "1", 5)
    shutil.copytree(sparse / "0", sparse / "2")
    read(colmap_scene)
    said = f"{sparse / '0'} registers 17 photos and is used; {sparse / '1'} 5, {sparse / '2'} 17\n"
    assert capsys.readouterr().err == said
    shutil.rmtree(sparse / "2")
    (sparse / "1").rename(sparse / "large")
    (sparse / "0").rename(sparse / "1")
    (sparse / "large").rename(sparse / "0")
    assert len(read(colmap_scene).train_cameras) == len(whole.train_cameras)
    assert capsys.readouterr().err == f"{sparse / '1'} registers 17 photos and is used; {sparse / '0'} 5\n"

    (sparse / "1" / "images.bin").write_bytes(b"broken")
    assert len(read(colmap_scene).train_cameras) == 5
    assert "images.bin ends within photo 1 of 1, or is no such file" in capsys.readouterr().err


def test_several_cameras_and_sizes(tmp_path):
    make_colmap_scene(tmp_path, views=4)
    sparse = tmp_path / "sparse" / "0"
    as_text(tmp_path)
    for name in ("rigs.txt", "frames.txt"):  # the classic three files allow any camera for any photo
        (sparse / name).unlink()
    with open(sparse / "cameras.txt", "a") as file:
        file.write("7 SIMPLE_RADIAL 48 32 55 22.5 17.25 -0.1\n")
    lines = (sparse / "images.txt").read_text().splitlines()
    for index, line in enumerate(lines):
        if line.endswith("png") and line.startswith("1 "):
            fields = line.split()
            lines[index] = " ".join([*fields[:8], "7", fields[9]])
            small = tmp_path / "images" / fields[9]
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    with Image.open(small) as image:
        image.resize((48, 32)).save(small)
    cameras = {camera.uid: camera for camera in read(tmp_path).train_cameras}
    assert set(cameras) == {1, 7}
    assert (cameras[1].width, cameras[1].file_size) == (WIDTH, (WIDTH, HEIGHT))
    assert cameras[7].fx == 55 and cameras[7].file_size == (cameras[7].width, cameras[7].height)
    assert cameras[7].width < 55


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to(path), lambda path: path.symlink_to("gone")])
def test_what_is_no_file_is_no_photo(colmap_scene, make):
    """Whoever opens a pipe waits for ever."""
    path = colmap_scene / "images" / "left" / "v02.png"
    path.unlink()
    make(path)
    with pytest.raises(UserError, match=r"photos .*left/v02.png \(a broken link, or not a file"):
        read(colmap_scene)


def test_a_photo_in_postscript_is_never_run(colmap_scene, monkeypatch):
    path = colmap_scene / "images" / "left" / "v02.png"
    with Image.open(path) as image:
        image.convert("RGB").save(path.with_suffix(".eps"))
    shutil.move(path.with_suffix(".eps"), path)
    monkeypatch.setattr(EpsImagePlugin, "Ghostscript", lambda *_, **__: pytest.fail("Ghostscript was started"))
    with pytest.raises(UserError, match="cannot read .*left/v02.png .*cannot identify image file"):
        read(colmap_scene)
