"""Smaller copies of photos for features, and models that are brought back to the size of the photos."""

import numpy as np
import pycolmap
import pytest
from PIL import Image

from splatting.sfm import reduced
from splatting.sfm.reduced import enlarged, longest_side, reduce_photos


@pytest.mark.parametrize(
    ("name", "mode"),
    [
        ("a.jpg", "RGB"),
        ("b.JPG", "CMYK"),
        ("c.png", "RGBA"),
        ("deep/d e.png", "P"),
        ("f.png", "I;16"),
        ("g.tif", "L"),
        ("h.bmp", "RGB"),
    ],
)
def test_large_photos_are_made_smaller(tmp_path, name, mode):
    photos, target, exif = tmp_path / "photos", tmp_path / "small", Image.Exif()
    exif[0x0110], exif[0xA405] = "model", 26
    (photos / name).parent.mkdir(parents=True)
    ramp = np.tile(np.linspace(0, 1, 200), (100, 1))
    deep = Image.fromarray((ramp * 65535).astype(np.uint16))
    plain = Image.fromarray((ramp * 255).astype(np.uint8))
    image = deep if mode == "I;16" else plain.convert("RGB").convert(mode)
    image.save(photos / name, **({"exif": exif} if name.lower().endswith("jpg") else {}))
    before = (photos / name).read_bytes()
    reduce_photos(photos, target, [name], 50, None)
    with Image.open(target / name) as small:
        assert small.size == (50, 25)
        if name == "a.jpg":
            assert small.getexif()[0x0110] == "model"
        seen = np.asarray(small.convert("L"), float)
    # The ramp is still one, from dark to bright.
    assert seen[:, :5].mean() < 40 and seen[:, -5:].mean() > 215 and (np.diff(seen.mean(0)) > -8).all()
    assert (photos / name).read_bytes() == before


def test_small_photos_are_linked_and_a_known_size_is_kept(tmp_path):
    (tmp_path / "photos").mkdir()
    Image.new("RGB", (104, 60), "red").save(tmp_path / "photos" / "a.png")
    reduce_photos(tmp_path / "photos", tmp_path / "small", ["a.png"], 100, None)
    assert (tmp_path / "small" / "a.png").samefile(tmp_path / "photos" / "a.png")
    reduce_photos(tmp_path / "photos", tmp_path / "other", ["a.png"], 100, (52, 30))
    assert Image.open(tmp_path / "other" / "a.png").size == (52, 30)
    assert longest_side(reduced.FEW) > longest_side(reduced.FEW + 1)


def test_a_model_is_brought_to_the_size_of_its_photos(tmp_path):
    model, track = pycolmap.Reconstruction(), pycolmap.Track()
    camera = pycolmap.Camera(model="OPENCV", width=100, height=60, params=[90, 91, 50, 30, 0.1, 0, 0, 0], camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    point = np.array([0.2, -0.1, 2.0])
    seen = np.asarray(camera.img_from_cam(point))
    for number in (1, 2):
        image = pycolmap.Image(name=f"{number}.png", keypoints=seen.reshape(1, 2), camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
        track.add_element(number, 0)
        Image.new("RGB", (400, 240)).save(tmp_path / f"{number}.png")
    model.add_point3D(point, track, np.zeros(3, np.uint8))
    model.write(str(tmp_path))
    found = enlarged(str(tmp_path), tmp_path)
    assert (found.cameras[1].width, found.cameras[1].height) == (400, 240)
    assert found.cameras[1].params == pytest.approx([360, 364, 200, 120, 0.1, 0, 0, 0])
    for image in found.images.values():
        assert image.points2D[0].xy == pytest.approx(4 * seen)
        assert image.project_point(point) == pytest.approx(4 * seen)
    assert found.compute_mean_reprojection_error() == pytest.approx(0, abs=1e-9)
