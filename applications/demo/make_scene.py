"""Make the demo scene: ray-traced images of analytic shapes, and a COLMAP model of them.

The points on the surfaces are noisy and coloured and have their tracks, as structure from motion would find them.

python -m applications.demo.make_scene OUT [--views 60] [--size 400 300] [--points 8000] [--seed 0]
                                        [--camera pinhole]
"""

import os
import shutil
from argparse import ArgumentParser
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from PIL import Image

from applications.demo.objects import Thing, demo_scene
from applications.demo.tracer import CAMERAS, View, render_view, ring_views, trace
from groundwork.host.machine import cores
from groundwork.host.progress import Bar
from utils.system_utils import UserError, mkdir_p, run_cli

PIXELS_PER_PROCESS = 1_000_000  # with fewer, starting another process (2 s) costs more time than it saves
POSITION_NOISE = 0.004  # standard deviation of a point, as a fraction of its distance from the view that found it
PIXEL_NOISE = 0.3  # standard deviation of an observation in pixels
MIN_TRACK = 3  # least number of views that see a point

Things = Callable[[int | None], list[Thing]]  # that stand in a photo, by its number; None: those that stay


def _make_demo_things(_: int | None) -> list[Thing]:
    """Return the things of the demo scene, which are the same in every view."""
    return demo_scene()


def _render_image(things: Things, samples: int, number: int, view: View) -> np.ndarray:
    """Ray-trace one view to a photo (H, W, 3) uint8. number: of the view, as a scene may move."""
    return render_view(things(number), view, samples)


def _render_images(views: list[View], things: Things, samples: int) -> list[np.ndarray]:
    """Ray-trace the views to photos, (H, W, 3) uint8 each, on several cores if that saves time."""
    pixels = sum(view.width * view.height for view in views)
    workers = min(cores(), 1 + pixels // PIXELS_PER_PROCESS)
    bar = partial(Bar, total=len(views), desc="Ray tracing", unit="view")
    image, numbers = partial(_render_image, things, samples), range(len(views))
    if workers == 1:
        return list(bar(map(image, numbers, views)))
    # Use processes, because numpy holds the interpreter's lock most of the time on blocks this small.
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        return list(bar(pool.map(image, numbers, views)))


@dataclass(frozen=True)
class SurfacePoints:
    """Coloured points and their observations in the views."""

    xyz: np.ndarray  # (N, 3), world units
    rgb: np.ndarray  # (N, 3) uint8
    seen: list[np.ndarray]  # for each view, the indices (K,) of the points that it sees
    keypoints: list[np.ndarray]  # for each view, their observed positions (K, 2) in pixels; pixel centres are at .5


def _sample_surface(
    things: list[Thing], views: list[View], count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return surface points (3, N) under `count` random pixels of random views, and their distances (N,)."""
    owner = np.sort(rng.integers(len(views), size=count))
    u, v = rng.uniform(size=(2, count))
    points = np.empty((3, count))
    distance = np.empty(count)
    for k, view in enumerate(views):
        mine = np.flatnonzero(owner == k)
        direction = view.rays(u[mine] * view.width, v[mine] * view.height)
        origin = view.center.reshape(3, 1)
        distance[mine], _ = trace(things, origin.astype(np.float32), direction)
        points[:, mine] = origin + distance[mine] * direction
    hits = np.isfinite(distance)
    return points[:, hits], distance[hits]


def _find_visible(things: list[Thing], view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices (K,) of the surface points (3, N) that a view sees, and their image positions (K, 2)."""
    x, y, z = view.project(points)
    inside = np.flatnonzero((z > 0) & (x >= 0) & (x < view.width) & (y >= 0) & (y < view.height))
    origin = view.center.reshape(3, 1)
    offset = points[:, inside] - origin
    distance = np.linalg.norm(offset, axis=0)
    hit, _ = trace(things, origin.astype(np.float32), (offset / distance).astype(np.float32))
    # Hits on a slanted surface move by far more than float32's rounding. All objects are much thicker than 0.02.
    near = hit > distance - 0.02
    return inside[near], np.stack([x, y], axis=1)[inside[near]]


def sample_points(
    things: list[Thing], views: list[View], images: list[np.ndarray], count: int, rng: np.random.Generator
) -> SurfacePoints:
    """Sample about `count` surface points with true visibility; drop points that fewer than MIN_TRACK views see.

    images: the views' photos, (H, W, 3) uint8. A point's colour is its mean over the photos that see it, so it does
    not depend on the view.
    """
    points, distance = _sample_surface(things, views, count, rng)
    count = len(distance)
    seen, exact = zip(*(_find_visible(things, view, points) for view in views), strict=True)
    track = np.bincount(np.concatenate(seen), minlength=count)
    colour = np.zeros((count, 3))
    for index, place, image in zip(seen, exact, images, strict=True):
        column, row = place.astype(int).T
        colour[index] += image[row, column]
    keep = track >= MIN_TRACK
    renumber = np.cumsum(keep) - 1
    xyz = points.T + rng.normal(size=(count, 3)) * (POSITION_NOISE * distance)[:, None]
    noisy = [place + rng.normal(scale=PIXEL_NOISE, size=place.shape) for place in exact]
    return SurfacePoints(
        xyz=xyz[keep],
        rgb=np.floor(colour[keep] / track[keep, None] + 0.5).astype(np.uint8),
        seen=[renumber[index[keep[index]]] for index in seen],
        keypoints=[place[keep[index]] for index, place in zip(seen, noisy, strict=True)],
    )


def write_model(folder: Path, names: list[str], views: list[View], points: SurfacePoints) -> None:
    """Make `folder` with a binary COLMAP model: one camera, an image per view, points with their tracks."""
    import pycolmap

    first = views[0]
    model = pycolmap.Reconstruction()
    size = {"width": first.width, "height": first.height}
    camera = pycolmap.Camera(model=first.model, **size, params=first.params, camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    tracks = [pycolmap.Track() for _ in points.xyz]
    for image_id, (name, view) in enumerate(zip(names, views, strict=True), 1):
        image = pycolmap.Image(name=name, keypoints=points.keypoints[image_id - 1], camera_id=1, image_id=image_id)
        translation = -view.rotation @ view.center
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(view.rotation), translation))
        for place, index in enumerate(points.seen[image_id - 1]):
            tracks[index].add_element(image_id, place)
    for xyz, track, rgb in zip(points.xyz, tracks, points.rgb, strict=True):
        model.add_point3D(xyz, track, rgb)
    model.update_point_3d_errors()
    folder.mkdir(parents=True)
    model.write_binary(folder)


def write_scene(
    out: Path, views: list[View], things: Things, points: int, rng: np.random.Generator, samples: int = 3
) -> int:
    """Write photos and a COLMAP model into a folder (images/, sparse/0), and return its number of points.

    things: a function that another process can import. samples: of `render_view`. UserError if there are no points.
    """
    (out / "images").mkdir(parents=True)
    images, names = _render_images(views, things, samples), [f"view_{k:03d}.png" for k in range(len(views))]
    for name, image in zip(names, images, strict=True):
        Image.fromarray(image).save(out / "images" / name)
    cloud = sample_points(things(None), views, images, points, rng)
    if not len(cloud.xyz):
        raise UserError(f"none of {points} points is visible in {MIN_TRACK} views; raise --points or --views")
    write_model(out / "sparse" / "0", names, views, cloud)
    return len(cloud.xyz)


def make_scene(
    out: Path,
    views: int,
    width: int,
    height: int,
    points: int,
    seed: int,
    camera: str = "pinhole",
    things: Things = _make_demo_things,
) -> int:
    """Write the scene to `out` (images/, sparse/0) and return its number of points.

    camera: of CAMERAS. The same arguments give the same photos and points. `out` appears only when it is complete.
    UserError if it exists and is not empty, if it cannot be made, or if the scene would have no points.
    """
    out = out.resolve()
    if out == Path.cwd():
        raise UserError("the scene cannot replace the current folder; name a new folder")
    if camera == "panorama" and width != 2 * height:
        raise UserError(
            f"a panorama is twice as wide as high, got {width} x {height}; give --size {width} {width // 2}"
        )
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(f"{out} exists and is not an empty folder; choose another one, or delete it first")
    rng = np.random.default_rng(seed)
    cameras = ring_views(views, width, height, rng, CAMERAS[camera])
    mkdir_p(out.parent)
    work = out.with_name(f".{out.name}.{os.getpid()}.tmp")
    try:
        count = write_scene(work, cameras, things, points, rng)
        if out.exists():
            out.rmdir()
        work.rename(out)
    except OSError as error:
        raise UserError(
            f"cannot write {out} ({error.strerror or error}); choose another place, or fix the permissions there"
        ) from error
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return count


def main() -> None:
    """Make the scene that the command line asks for."""
    parser = ArgumentParser(
        prog="python -m applications.demo.make_scene", description="Make the ray-traced demo scene."
    )
    add = parser.add_argument
    add("out", type=Path, help="folder to make, with images/ and sparse/0")
    add("--views", type=int, default=60, help="number of photos, on three rings (60)")
    add("--size", type=int, nargs=2, default=(400, 300), metavar=("W", "H"),
        help="size of the photos in pixels (400 300)")  # fmt: skip
    add("--points", type=int, default=8000, help="surface points to try; a few are dropped (8000)")
    add("--seed", type=int, default=0, help="seed of the cameras' jitter and of the points (0)")
    add("--camera", choices=CAMERAS, default="pinhole",
        help="a fisheye is 200 degrees wide; a panorama shows all, and is twice as wide as high (pinhole)")  # fmt: skip
    args = parser.parse_args()
    for option, least in (("views", 3), ("size", 16), ("points", 1), ("seed", 0)):
        value = np.min(getattr(args, option))
        if value < least:
            raise UserError(f"--{option} must be at least {least}, got {value}")
    count = make_scene(args.out, args.views, *args.size, args.points, args.seed, args.camera)
    print(f"{args.out}: {args.views} photos of {args.size[0]}x{args.size[1]} pixels, {count} points")


if __name__ == "__main__":
    run_cli(main)
