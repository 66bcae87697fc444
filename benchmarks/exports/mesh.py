"""Distance of a model's mesh from the true surfaces, and how much of these it has: of scenes that are ray-traced.

    python -m benchmarks.exports.mesh -m MODEL --voxels 0.03 0.015

MODEL is a training of the scene `clean` of `python -m benchmarks.scenes.made`, whose things are the truth. Figures are
of the middle of the scene, in its unit; the cameras are 3.6 away. Accuracy: distances of the mesh's vertices from the
nearest surface. Completeness: distances of places that training photos show from the nearest vertex, which would be
some 0.4 voxels for a perfect mesh. `export.py` writes the large parts.
"""

import time

import numpy as np
from scipy.spatial import KDTree

from arguments import ModelParams, OptionParser, PipelineParams, get_combined_args
from benchmarks.harness.measuring import describe, print_table
from scene.cameras import Camera
from scene.saved_model import load_saved
from scene.with_splats import splats_of
from splatting.demo.objects import Box, Ground, Sphere, Thing, demo_scene
from splatting.demo.tracer import TARGET, trace
from splatting.exports.mesh import Mesh, large_parts, volume_of, zero_level
from utils.system_utils import compute_device, run_cli

RADIUS = 2.5  # around the point that the cameras face
PLACES = 200_000  # on true surfaces, at most
CLOSE = 0.02


def true_distances(things: list[Thing], points: np.ndarray) -> np.ndarray:
    """Distances (R,) of points (3, R) from the nearest surface."""
    return np.min([_distances(thing, points) for thing in things], axis=0)


def _distances(thing: Thing, points: np.ndarray) -> np.ndarray:
    shape = thing.shape
    if isinstance(shape, Ground):
        return np.hypot(points[1], np.maximum(np.hypot(points[0], points[2]) - shape.radius, 0))
    if isinstance(shape, Sphere):
        return np.abs(np.linalg.norm(points - np.reshape(shape.center, (3, 1)), axis=0) - shape.radius)
    if isinstance(shape, Box):
        half = np.reshape(shape.half, (3, 1))
        over = np.abs(shape.local(points)) * half - half
        return np.abs(np.linalg.norm(np.maximum(over, 0), axis=0) + np.minimum(over.max(axis=0), 0))
    return np.abs(shape.distance(points))


def seen_places(things: list[Thing], cameras: list[Camera], count: int) -> np.ndarray:
    """(P, 3) places in the middle of the scene, under random pixels of the cameras' photos."""
    rng, found = np.random.default_rng(0), []
    for camera in cameras:
        x, y = rng.uniform(size=(2, -(-count // len(cameras))))
        local = [(x * camera.image_width - camera.cx) / camera.fx, (y * camera.image_height - camera.cy) / camera.fy]
        direction = camera.R @ np.stack([*local, np.ones_like(x)])
        direction /= np.linalg.norm(direction, axis=0)
        center = camera.camera_center.cpu().numpy().astype(np.float64)[:, None]
        distance, _ = trace(things, center.astype(np.float32), direction.astype(np.float32))
        found.append((center + np.where(np.isfinite(distance), distance, 1e9) * direction).T)
    places = np.concatenate(found)
    return places[_central(places)]


def _central(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points - TARGET, axis=1) < RADIUS


def judge(mesh: Mesh, things: list[Thing], places: np.ndarray) -> dict[str, float]:
    """Means and 95 % of the two distances, and the share of places that have a vertex within CLOSE."""
    vertices = mesh.vertices[_central(mesh.vertices)]
    accuracy = true_distances(things, vertices.T.astype(np.float32))
    completeness = KDTree(vertices).query(places)[0]
    return {
        "accuracy": accuracy.mean(),
        "accuracy_95": np.quantile(accuracy, 0.95),
        "completeness": completeness.mean(),
        "completeness_95": np.quantile(completeness, 0.95),
        "close": float((completeness < CLOSE).mean()),
    }


def main() -> None:
    parser = OptionParser(description=__doc__.splitlines()[0])
    models, pipelines = ModelParams(parser, sentinel=True), PipelineParams(parser, sentinel=True)
    parser.add_argument("--voxels", type=float, nargs="+", default=[0.03, 0.015], help="sizes (default: 0.03 0.015)")
    args = get_combined_args(parser)
    pipe, scene, things = pipelines.extract(args), load_saved(models.extract(args), -1), demo_scene()
    cameras, splats = scene.getTrainCameras(), splats_of(scene.gaussians, bool(args.antialiasing))
    places, rows = seen_places(things, cameras, PLACES), []
    for voxel in args.voxels:
        start = time.perf_counter()
        every = zero_level(volume_of(splats, cameras, pipe, voxel))
        seconds = time.perf_counter() - start
        for part, mesh in (("large", large_parts(every)), ("all", every)):
            figures = judge(mesh, things, places)
            row = [f"{voxel:g}", part, f"{len(mesh.faces):,}", *(f"{value:.4f}" for value in figures.values())]
            rows.append([*row, f"{seconds:.1f}"])
    print(describe(compute_device()))
    names = ["accuracy", "95 %", "completeness", "95 %", f"within {CLOSE}"]
    print_table(["voxel", "parts", "triangles", *names, "seconds"], rows)


if __name__ == "__main__":
    run_cli(main)
