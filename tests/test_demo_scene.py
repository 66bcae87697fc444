"""The demo's ray tracer and its COLMAP model, against closed forms and pycolmap."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from splatting.demo import make_scene as maker
from splatting.demo.make_scene import make_scene
from splatting.demo.objects import Box, Ground, Shape, Sphere, Torus, demo_scene
from splatting.demo.tracer import CAMERAS, render_view, ring_views
from utils.system_utils import UserError

VIEWS, WIDTH, HEIGHT, POINTS = 12, 80, 60, 600

SPHERE = Sphere((0.2, -0.4, 0.3), 0.7)
TORUS = Torus((-0.15, -0.62, 0.95), (0.35, -0.55, 0.75), 0.42, 0.16)
BOX = Box((0.9, -0.4, 0.5), (0.3, 0.4, 0.2), 0.5)


@pytest.fixture(scope="module")
def scene(once) -> Path:
    return once("demo_scene", lambda out: make_scene(out, VIEWS, WIDTH, HEIGHT, POINTS, seed=3))


@pytest.fixture(scope="module")
def model(scene):
    return pycolmap.Reconstruction(scene / "sparse" / "0")


def rays(count: int, center: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Origins (3, R) around a centre and unit directions (3, R) towards points near it, float64."""
    rng = np.random.default_rng(11)
    origin = rng.normal(size=(3, count))
    origin = np.asarray(center)[:, None] + 3 * origin / np.linalg.norm(origin, axis=0)
    direction = np.asarray(center)[:, None] + rng.uniform(-0.7, 0.7, (3, count)) - origin
    return origin, direction / np.linalg.norm(direction, axis=0)


def inside(shape: Shape, p: np.ndarray) -> np.ndarray:
    """The depth of points (3, N) in a solid, positive inside; float64, independent of the tracer."""
    offset = p - np.reshape(getattr(shape, "center", (0, 0, 0)), (3, 1))
    if isinstance(shape, Ground):
        return p[1]
    if isinstance(shape, Sphere):
        depth = shape.radius - np.linalg.norm(offset, axis=0)
        return -depth if shape.inside else depth
    if isinstance(shape, Torus):
        axis = np.asarray(shape.axis) / np.linalg.norm(shape.axis)
        height = axis @ offset
        ring = np.linalg.norm(offset - axis[:, None] * height, axis=0)
        return shape.tube - np.hypot(ring - shape.radius, height)
    c, s = np.cos(shape.turn), np.sin(shape.turn)
    local = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) @ offset
    return (np.reshape(shape.half, (3, 1)) - np.abs(local)).min(axis=0)


@pytest.mark.parametrize("shape", [SPHERE, TORUS, BOX, Ground(9.0), Sphere((0, 0, 0), 9.0, inside=True)])
def test_hits_are_the_first_points_on_the_surface_and_normals_point_out(shape):
    center = getattr(shape, "center", (0, -0.2, 0))
    origin, direction = rays(500, center)
    if isinstance(shape, Ground):
        origin[1] = -np.abs(origin[1]) - 0.1
    t = shape.intersect(origin.astype(np.float32), direction.astype(np.float32)).astype(np.float64)
    hit = np.isfinite(t)
    assert hit.sum() > 100
    o, d, t = origin[:, hit], direction[:, hit], t[hit]
    point = o + t * d
    assert np.abs(inside(shape, point)).max() < 5e-4  # float32 at distances of 10, and the marching's 2e-4
    for part in np.linspace(0.02, 0.98, 49):
        assert inside(shape, o + part * t * d).max() < 1e-3
    # A ray that misses is never inside the solid.
    if not isinstance(shape, Ground):
        for part in np.linspace(0, 6, 200):
            assert inside(shape, origin[:, ~hit] + part * direction[:, ~hit]).max(initial=-1) < 3e-3

    normal = shape.normal(point.astype(np.float32)).astype(np.float64)
    assert np.allclose(np.linalg.norm(normal, axis=0), 1, atol=1e-5)
    step = 1e-3
    slope = inside(shape, point - step * normal) - inside(shape, point + step * normal)
    # The change is 2 * step along the true normal; hits within a step of a box's edge have two normals.
    assert np.quantile(slope, 0.02) > 1.98 * step


def test_samples_average_what_a_pixel_covers():
    view = ring_views(3, 24, 16, np.random.default_rng(0))[0]
    things = demo_scene()
    fine = render_view(things, view, samples=8).astype(float)
    # Supersampling converges: more samples come nearer to the true mean.
    errors = [np.abs(render_view(things, view, samples=n) - fine).mean() for n in (1, 3)]
    assert errors[1] < 0.5 * errors[0]
    assert errors[1] < 2.0  # of 255


@pytest.mark.parametrize(("camera", "size"), [("fisheye", (80, 60)), ("panorama", (80, 40))])
def test_wide_cameras_are_pycolmaps(tmp_path, camera, size):
    (view, *_) = ring_views(3, *size, np.random.default_rng(0), CAMERAS[camera])
    x, y = np.random.default_rng(1).uniform(0.02, 0.98, (2, 500)) * np.reshape(size, (2, 1))
    points = view.center[:, None] + 3 * view.rays(x, y).astype(np.float64)
    assert np.abs(np.stack(view.project(points)) - [x, y, np.full(500, 3.0)]).max() < 1e-4  # rays are float32
    theirs = pycolmap.Camera(model=view.model, width=size[0], height=size[1], params=view.params)
    local = (view.rotation @ (points - view.center[:, None])).T
    front = local[:, 2] > 0
    assert 200 < front.sum() < 450
    assert np.abs(theirs.img_from_cam(local[front]) - np.stack([x, y], 1)[front]).max() < 1e-4
    make_scene(tmp_path / "scene", VIEWS, *size, POINTS, 3, camera)
    model = pycolmap.Reconstruction(tmp_path / "scene" / "sparse" / "0")
    assert model.num_points3D() > 0.6 * POINTS
    for image in model.images.values():
        seen = [(p.xy, image.project_point(model.points3D[p.point3D_id].xyz)) for p in image.points2D]
        errors = [np.linalg.norm(xy - place) for xy, place in seen if place is not None]
        assert np.median(errors) < 1  # noise of 0.3 px, and of 0.4 % of the distance


def test_pycolmap_reads_a_valid_model(model, scene):
    assert model.is_valid()
    assert model.num_reg_images() == VIEWS
    assert 0.6 * POINTS < model.num_points3D() <= POINTS  # with so few views many points are seen by fewer than three
    camera = model.cameras[1]
    assert (camera.model_name, camera.width, camera.height) == ("PINHOLE", WIDTH, HEIGHT)
    names = sorted(image.name for image in model.images.values())
    assert names == sorted(file.name for file in (scene / "images").iterdir())
    with Image.open(scene / "images" / names[0]) as picture:
        assert picture.size == (WIDTH, HEIGHT)


def test_points_project_near_their_observations(model):
    # Expected noise per axis: position 0.004 * 72 px (focal length) and observation 0.3 px; the mean length is 0.52 px.
    assert 0.3 < model.compute_mean_reprojection_error() < 0.8
    for point in list(model.points3D.values())[::20]:
        seen = [(model.images[element.image_id], element.point2D_idx) for element in point.track.elements]
        errors = [np.linalg.norm(image.project_point(point.xyz) - image.points2D[index].xy) for image, index in seen]
        assert np.mean(errors) == pytest.approx(point.error, rel=1e-6)


def test_tracks_are_what_is_visible(model):
    """Nothing is between a camera and a point that it observes; something is in front of other points in the frame.

    The scene's points are noisy, so both hold for nearly all of them.
    """
    things = demo_scene()
    part = np.linspace(0.05, 0.97, 120)
    blocked = {True: [], False: []}
    for image in model.images.values():
        center = image.projection_center()[:, None]
        seen = {point2d.point3D_id for point2d in image.points2D}
        for point_id, point in model.points3D.items():
            place = image.project_point(point.xyz)
            if place is None or not (1 < place[0] < WIDTH - 1 and 1 < place[1] < HEIGHT - 1):
                continue
            line = center + part * (point.xyz[:, None] - center)
            depth = max(inside(thing.shape, line).max() for thing in things)
            blocked[point_id in seen].append(depth > 0.03)
    assert len(blocked[True]) > 2000 and len(blocked[False]) > 100
    assert np.mean(blocked[True]) < 0.02
    assert np.mean(blocked[False]) > 0.8


def test_views_agree_on_colours_except_where_it_is_glossy(model, scene):
    """A point has about the same colour in all views that see it; it would not if poses and photos disagreed."""
    samples: dict[int, list[np.ndarray]] = {}
    for image in model.images.values():
        pixels = np.asarray(Image.open(scene / "images" / image.name), float)
        for point2d in image.points2D:
            x, y = np.clip(point2d.xy.astype(int), 0, (WIDTH - 1, HEIGHT - 1))
            samples.setdefault(point2d.point3D_id, []).append(pixels[y, x])
    spread = [np.std(values, axis=0).mean() for values in samples.values()]
    assert np.median(spread) < 0.4 * np.concatenate(list(samples.values())).std(axis=0).mean()
    # The model's colours come from positions without observation noise, so not from exactly these pixels.
    errors = np.array([np.abs(np.mean(v, axis=0) - model.points3D[k].color) for k, v in samples.items()])
    assert errors.max() < 70 and np.median(errors.mean(axis=1)) < 6


def test_colour_depends_on_the_view_where_it_is_glossy():
    things = demo_scene()
    glossy = next(thing for thing in things if thing.mirror > 0.1)
    matt = [thing if thing is not glossy else type(thing)(thing.shape, thing.texture) for thing in things]
    view = ring_views(3, 60, 45, np.random.default_rng(0))[0]
    assert (render_view(things, view, 1) != render_view(matt, view, 1)).any()


def test_same_seed_same_bytes_and_another_seed_another_scene(tmp_path):
    folders = [tmp_path / name for name in "abc"]
    for folder, seed in zip(folders, (5, 5, 6), strict=True):
        make_scene(folder, 3, 24, 18, 60, seed)
    files = sorted(file.relative_to(folders[0]) for file in folders[0].rglob("*") if file.is_file())
    assert len(files) >= 6
    contents = [[(folder / file).read_bytes() for file in files] for folder in folders]
    assert contents[0] == contents[1]
    assert contents[0] != contents[2]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "c"]  # no temporary folder is left


def test_other_processes_give_the_same_pictures(monkeypatch):
    views = ring_views(4, 24, 18, np.random.default_rng(0))
    alone = maker._images(views, maker._demo, 2)
    monkeypatch.setattr(maker, "PIXELS_PER_PROCESS", 24 * 18)
    monkeypatch.setattr(maker, "cores", lambda: 2)
    assert np.array_equal(maker._images(views, maker._demo, 2), alone)


@pytest.mark.parametrize(
    ("out", "points", "said"),
    [
        ("", 60, "not an empty folder"),
        (".", 60, "current folder"),
        ("mine.txt/out", 60, "(cannot|cannot make the folder) .*; choose another place"),
        ("new", 1, "none of 1 points is visible in 3 views"),
    ],
)
def test_a_scene_that_cannot_be_made_changes_nothing(tmp_path, monkeypatch, out, points, said):
    (tmp_path / "mine.txt").write_text("keep")
    monkeypatch.chdir(tmp_path if out == "." else tmp_path.parent)
    with pytest.raises(UserError, match=said):
        make_scene(tmp_path / out, 3, 24, 18, points, 0)
    assert [file.name for file in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--views 0", "--views must be at least 3, got 0"),
        ("--size 400 15", "--size must be at least 16, got 15"),
        ("--points 0", "--points must be at least 1, got 0"),
        ("--seed -1", "--seed must be at least 0, got -1"),
    ],
)
def test_absurd_numbers_end_with_a_sentence(tmp_path, monkeypatch, words, said):
    monkeypatch.setattr("sys.argv", ["make_scene", str(tmp_path / "out"), *words.split()])
    with pytest.raises(UserError, match=f"^{said}$"):
        maker.main()
    assert not (tmp_path / "out").exists()
