"""The cloud that training starts from: files of points of several formats, and random points in the cameras' views."""

import json
import tracemalloc
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from synthetic import read

from scene.readers.point_cloud import read_point_cloud, write_point_cloud
from scene.readers.start_cloud import random_in_frusta
from utils.sh_utils import C0
from utils.system_utils import UserError

POINTS = np.array([[0.25, -1.5, 3.0], [4.0, 5.5, -6.0]])
BYTES = np.array([[255, 0, 51], [102, 255, 204]])


@pytest.mark.parametrize(
    "text",
    [
        "0.25 -1.5 3 255 0 51\n4 5.5 -6 102 255 204\n",
        "x,y,z,r,g,b\n0.25,-1.5,3,255,0,51\n4,5.5,-6,102,255,204",
        "# by hand\n0.25 -1.5 3e0   1 0 0.2\n\n4 5.5 -6 0.4 1 0.8\n",
        "0,25;-1,5;3,0;255;0;51\n4;5,5;-6;102;255;204\n",
        "//X,Y,Z,Rf,Gf,Bf\n2\n0.25,-1.5,3,1,0,0.2\n4,5.5,-6,0.4,1,0.8\n",
        '"Red" "Green" "Blue" "x" "y" "z"\n255 0 51 0.25 -1.5 3\n102 255 204 4 5.5 -6\n',
        "2\n0.25 -1.5 3 17 255 0 51\n4 5.5 -6 99 102 255 204\n",
        "0.25 -1.5 3 -1200 255 0 51\n4 5.5 -6 -800 102 255 204\n",
        "0.25 -1.5 3 255 0 51 0 0 -1\n4 5.5 -6 102 255 204 0.6 0.8 0\n",
        "0.25 -1.5 3 0 0 -1 255 0 51\n4 5.5 -6 0.6 0.8 0 102 255 204\n",
        "0,25 -1,5 3 255 0 51\n4,0 5,5 -6,0 102 255 204\n",
        "0,25\t-1,5\t3\t1\t0,0\t2e-1\n4\t5,5\t-6\t0,4\t1\t0,8\n",
        "x y z intensity red green blue\n0.25 -1.5 3 17 255 0 51\n4 5.5 -6 99 102 255 204\n",
        "# in Gr\xf6\xdfe\n0.25 -1.5 3 255 0 51\n4 5.5 -6 102 255 204\n",
    ],
)
def test_text(tmp_path, text):
    (tmp_path / "a.xyz").write_bytes(text.encode("latin-1"))
    cloud = read_point_cloud(tmp_path / "a.xyz")
    np.testing.assert_array_equal(cloud.points, np.float32(POINTS))
    np.testing.assert_allclose(cloud.colors, BYTES / 255, atol=1e-7)
    write_point_cloud(tmp_path / "ply.xyz", POINTS, BYTES)  # the content tells the kind
    np.testing.assert_array_equal(read_point_cloud(tmp_path / "ply.xyz").points, cloud.points)
    assert cloud.points.dtype == np.float64 and cloud.colors.dtype == cloud.normals.dtype == np.float32


@pytest.mark.parametrize("keys", [("points", "colors"), ("xyz", "rgb")])
@pytest.mark.parametrize("colors", [BYTES.astype(np.uint8), BYTES.astype(np.uint16) * 257, BYTES / 255])
def test_npz(tmp_path, keys, colors):
    np.savez(tmp_path / "a.npz", **dict(zip(keys, (POINTS, colors), strict=True)), other=np.zeros(3))
    cloud = read_point_cloud(tmp_path / "a.npz")
    np.testing.assert_array_equal(cloud.points, np.float32(POINTS))
    np.testing.assert_allclose(cloud.colors, BYTES / 255, atol=1e-7)


def _write_ply(path: Path, columns: list[tuple[str, str]], rows: np.ndarray) -> None:
    vertices = np.array([tuple(row) for row in rows], dtype=columns)
    PlyData([PlyElement.describe(vertices, "vertex")]).write(str(path))


KINDS = [("u1", 255), ("i4", 255), ("u2", 255), ("u2", 65535), ("i4", 65535), ("f4", 1), ("f4", 255)]
NAMES = ["red green blue", "Red Green Blue", "diffuse_red diffuse_green diffuse_blue", "r g b"]


@pytest.mark.parametrize(("names", "kind", "part"), [(NAMES[i % 4], *kind) for i, kind in enumerate(KINDS)])
def test_colours_of_a_ply(tmp_path, names, kind, part):
    """Integers up to 255 are bytes, whatever their type."""
    columns = [*((axis, "f8") for axis in "XYZ"), *((name, kind) for name in names.split())]
    _write_ply(tmp_path / "a.ply", columns, np.column_stack([POINTS, BYTES / 255 * part]))
    cloud = read_point_cloud(tmp_path / "a.ply")
    np.testing.assert_array_equal(cloud.points, POINTS)
    np.testing.assert_allclose(cloud.colors, BYTES / 255, atol=1e-7)
    of_a_model = [(name, "f4") for name in ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2")]
    _write_ply(tmp_path / "b.ply", of_a_model, np.column_stack([POINTS, (BYTES / 255 - 0.5) / C0]))
    np.testing.assert_allclose(read_point_cloud(tmp_path / "b.ply").colors, BYTES / 255, atol=1e-6)


def test_points_without_colours_are_grey(tmp_path, capsys):
    np.savez_compressed(tmp_path / "a.npz", points=POINTS)
    (tmp_path / "a.txt").write_text("0.25 -1.5 3\n4 5.5 -6\n")
    (tmp_path / "b.txt").write_text("x y z intensity\n0.25 -1.5 3 7\n4 5.5 -6 9\n")
    (tmp_path / "c.txt").write_text("0.25 -1.5 3 0 0 -1\n4 5.5 -6 0.6 0.8 0\n")
    _write_ply(tmp_path / "a.ply", [("x", "f4"), ("y", "f4"), ("z", "f4")], POINTS)
    for name in ("a.npz", "a.txt", "b.txt", "c.txt", "a.ply"):
        cloud = read_point_cloud(tmp_path / name)
        np.testing.assert_array_equal(cloud.points, np.float32(POINTS))
        assert (cloud.colors == np.float32(127 / 255)).all()
        assert f"{name} has no colours; its points begin grey" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.xyz", b"1 2\n3 4\n", "not text with x y z .*2 columns"),
        ("a.xyz", b"1 2 3\n4 5 six\n", "not text with x y z"),
        ("a.xyz", b"only words\n", "no numbers"),
        ("a.xyz", b"1 2 nan\n", r"1 of 1 points .* are not finite \(first: number 0\)"),
        ("a.xyz", b"1 2 3 400 0 0\n", "neither integers nor between 0 and 1"),
        ("a.xyz", b"1 2 3 0.5 1.1 0\n", "between 0 and 1: they range from 0 to 1.1"),
        ("a.xyz", b"1 2 3 4 5 6 7 8\n", "8 columns, whose first line does not name them"),
        ("a.npz", b"PK\x03\x04 broken", "not a readable npz"),
        ("a.txt", b"0.25 -1.5 3 17 255 0 51\n4 5.5 -6 99 102 255 204\n", "from the 4th or from the 5th on may be red"),
        (
            "a.pcd",
            b"# .PCD v0.7\nFIELDS x y z rgb\nDATA ascii\n1 2 3 4.8e6\n",
            "is not read; save it as PLY",
        ),
        ("a.txt", b"LASF\0\0", "a kind that is not read"),
        ("a.E57", b"ASTM-E57", "a kind that is not read"),
    ],
)
def test_bad_files(tmp_path, name, content, said):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=said) as error:
        read_point_cloud(tmp_path / name)
    assert str(tmp_path / name) in str(error.value)


def _refused_in_little_memory(path: Path) -> None:
    tracemalloc.start()
    with pytest.raises(UserError, match="not a readable npz .*save points and colors .* by numpy.savez"):
        read_point_cloud(path)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 2_000_000


@pytest.mark.parametrize(
    "arrays",
    [
        *({"a": POINTS}, {"points": POINTS[:, :2]}, {"points": POINTS, "colors": BYTES[:1]}, {"points": [{}, {}]}),
        {"points": np.zeros((5_000_000, 3), np.int8)},
        {"points": POINTS, "colors": np.zeros((5_000_000, 3), np.int8)},
        {"points": np.zeros((1, 3), "V30000000")},
        {"points": POINTS + 0j},
    ],
)
def test_bad_arrays(tmp_path, arrays):
    """Also those that pack to a few bytes, of which little is unpacked."""
    np.savez_compressed(tmp_path / "a.npz", **{name: np.array(value) for name, value in arrays.items()})
    _refused_in_little_memory(tmp_path / "a.npz")


def test_an_array_of_a_long_header_is_refused_before_it_is_unpacked(tmp_path):
    """NumPy unpacks as many bytes as its format 2 says, up to 4 GiB."""
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", b"\x93NUMPY\x02\x00" + (20_000_000).to_bytes(4, "little") + bytes(20_000_000))
    _refused_in_little_memory(tmp_path / "a.npz")


def test_points_that_pack_well_are_read(tmp_path):
    """A lattice of one colour takes 3 bytes a point, and 65,536 equal points take next to nothing."""
    lattice = np.stack(np.meshgrid(*[np.arange(50)] * 3), axis=-1).reshape(-1, 3)
    for points in (lattice, np.zeros((65_536, 3))):
        np.savez_compressed(tmp_path / "a.npz", points=points, colors=np.full(points.shape, 0.5))
        np.testing.assert_array_equal(read_point_cloud(tmp_path / "a.npz").points, points)


def test_random_points_lie_where_cameras_look(colmap_scene):
    info = read(colmap_scene, init_type="random")
    points = info.point_cloud.points.astype(np.float64)
    assert points.shape == (100_000, 3) and (info.point_cloud.colors == np.float32(127 / 255)).all()
    seen = np.zeros(len(points), int)
    for camera in info.train_cameras:
        x, y, z = (points @ camera.R + camera.T).T
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        margin = 1e-3  # pixels: the points are float32
        seen += (z > 0) & (abs(u - 48) <= 48 + margin) & (abs(v - 32) <= 32 + margin)
    assert seen.min() >= 1 and seen.max() > 1
    np.testing.assert_array_equal(read(colmap_scene, init_type="random").point_cloud.points, info.point_cloud.points)


def test_random_points_of_cameras_side_by_side(colmap_scene):
    camera = read(colmap_scene).train_cameras[0]
    row = [replace(camera, T=camera.T + (0.1 * step, 0, 0)) for step in range(5)]
    points = random_in_frusta(row).points
    depth = (points @ camera.R + camera.T)[:, 2]
    # Parallel axes do not meet, so depths are from a quarter of the extent, 1.1 x 0.2, up to 2.5 times it.
    assert depth.min() == pytest.approx(0.25 * 0.22, rel=0.01) and depth.max() == pytest.approx(2.5 * 0.22, rel=0.01)


def test_random_points_of_a_blender_scene_are_the_references_cube(blender_scene):
    write_point_cloud(blender_scene / "points3d.ply", POINTS, BYTES)
    assert len(read(blender_scene).point_cloud.points) == 2
    info = read(blender_scene, init_type="random")
    assert info.ply_path is None and np.abs(info.point_cloud.points).max() <= np.float32(1.3)


@pytest.mark.parametrize("random", [{}, {"init_type": "random"}])
@pytest.mark.parametrize("scale", [1e-3, 1])
@pytest.mark.parametrize("move", [(0, 0, 0), (1e6, -3e5, 10)])
def test_random_points_of_a_blender_scene_in_any_unit(blender_scene, capsys, random, scale, move):
    plain = read(blender_scene, **random).point_cloud.points
    _change_poses(blender_scene, lambda pose: pose[:3, 3].__imul__(scale).__iadd__(np.array(move) * max(scale, 1)))
    info = read(blender_scene, **random)
    points = (info.point_cloud.points + info.offset - np.array(move) * max(scale, 1)) / scale
    if scale == 1 and not any(move):
        np.testing.assert_array_equal(points, plain)
        return
    np.testing.assert_allclose(points / np.abs(points).max(), plain / 1.3, atol=0.02)
    assert "random points are put into a cube" in capsys.readouterr().err


def _change_poses(scene: Path, change) -> None:
    """Change the poses (4, 4) of a Blender scene's cameras in place."""
    for file in scene.glob("transforms_*.json"):
        content = json.loads(file.read_text())
        for frame in content["frames"]:
            change(pose := np.array(frame["transform_matrix"]))
            frame["transform_matrix"] = pose.tolist()
        file.write_text(json.dumps(content))


def test_random_points_where_blender_cameras_look_outwards(blender_scene, capsys):
    _change_poses(blender_scene, lambda pose: pose[:3, 1:3].__imul__(-1))
    info = read(blender_scene)
    points = info.point_cloud.points
    assert info.has_random_points and np.linalg.norm(points, axis=1).max() > 8
    assert "random points are put into the views; their axes must be those of OpenGL" in capsys.readouterr().err


def test_a_cloud_of_no_points(colmap_scene):
    write_point_cloud(colmap_scene / "sparse" / "0" / "points3D.ply", np.zeros((0, 3)), np.zeros((0, 3)))
    with pytest.raises(UserError, match="has no points; start from random points with --init_type random, or from a f"):
        read(colmap_scene)
