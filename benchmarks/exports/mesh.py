"""Distance of a model's mesh from the true surfaces, how much of these it has, and how near its texture is to photos.

    python -m benchmarks.exports.mesh -m MODEL --triangles 200000 50000

MODEL is a training of the scene `clean` of `python -m benchmarks.scenes.made`, whose things are the truth. Figures are
of the middle of the scene, in its unit; the cameras are 3.6 away. Accuracy: distances of points spread over the mesh
from the nearest surface. Completeness: distances of places that training photos show from the nearest such point, which
would be some 0.01 for a perfect mesh. PSNR: of the textured mesh in the training views, where it covers them, against
photos, and against renders of the Gaussians.
"""

import time

import numpy as np
import torch
from scipy.spatial import KDTree
from torch.nn.functional import grid_sample

from applications.demo.objects import Box, Ground, Sphere, Thing, demo_scene
from applications.demo.tracer import TARGET, trace
from applications.export.mesh import CONFIRMED, Mesh, extract_zero_level, fuse_volume, reduce_triangles, vertex_normals
from applications.export.mesh_cleaning import area_vectors, keep_whole_parts, smooth_rims
from applications.export.surfaces import Surfaces
from applications.export.texture import barycentric, find_owners, make_texture
from arguments import ModelParams, OptionParser, PipelineParams, get_combined_args
from benchmarks.harness.measuring import describe_machine, print_table
from scene.cameras import Camera
from scene.saved_model import load_saved
from scene.with_splats import splats_of
from utils.system_utils import compute_device, run_cli

RADIUS = 2.5  # around the point that the cameras face
PLACES = 200_000  # on true surfaces, at most
POINTS = 1_000_000  # on a mesh
CLOSE = 0.02


def true_distances(things: list[Thing], points: np.ndarray) -> np.ndarray:
    """Distances (R,) of points (3, R) from the nearest surface."""
    return np.min([_surface_distances(thing, points) for thing in things], axis=0)


def _surface_distances(thing: Thing, points: np.ndarray) -> np.ndarray:
    """Return the distances (R,) of points (3, R) from the surface of a thing."""
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
    return places[_is_central(places)]


def _is_central(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points - TARGET, axis=1) < RADIUS


def spread(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(P, 3) points in the middle of the scene, evenly spread over a mesh's surface."""
    faces = faces[_is_central(vertices[faces].mean(axis=1))]
    areas, rng = np.linalg.norm(area_vectors(vertices, faces), axis=1), np.random.default_rng(0)
    rows = rng.choice(len(faces), POINTS, p=areas / areas.sum())
    shares = rng.dirichlet(np.ones(3), POINTS)
    return np.einsum("nk,nkc->nc", shares, vertices[faces[rows]])


def judge(vertices: np.ndarray, faces: np.ndarray, things: list[Thing], places: np.ndarray) -> dict[str, float]:
    """Means and 95 % of the two distances, and the share of places that have a point of the mesh within CLOSE."""
    points = spread(vertices, faces)
    accuracy = true_distances(things, points.T.astype(np.float32))
    completeness = KDTree(points).query(places)[0]
    return {
        "accuracy": accuracy.mean(),
        "accuracy_95": np.quantile(accuracy, 0.95),
        "completeness": completeness.mean(),
        "completeness_95": np.quantile(completeness, 0.95),
        "close": float((completeness < CLOSE).mean()),
    }


def picture_of(mesh: Mesh, camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """A view (3, H, W) of a textured mesh, and which pixels (H, W) it covers. Nearer triangles hide farther ones."""
    size = np.array([camera.image_width, camera.image_height])
    matrix = camera.full_proj_transform.cpu().double().numpy()
    clip = mesh.vertices @ matrix[:3] + matrix[3]
    depths = clip[:, 3]
    with np.errstate(all="ignore"):
        pixels = (clip[:, :2] / depths[:, None] + 1) * size / 2
    at = mesh.faces
    ahead = (depths[at] > 0.01).all(axis=1)
    inside = (pixels[at].min(axis=1) < size).all(axis=1) & (pixels[at].max(axis=1) > 0).all(axis=1)
    drawn = at[ahead & inside]
    drawn = drawn[np.argsort(-depths[drawn].mean(axis=1))]
    owners = find_owners(drawn, pixels, size)
    covered = owners >= 0
    corners = drawn[owners[covered]]
    shares = barycentric(pixels, corners, np.argwhere(covered)[:, ::-1] + 0.5) / depths[corners]
    shares /= shares.sum(axis=1, keepdims=True)
    places = torch.from_numpy(np.einsum("nk,nkc->nc", shares, mesh.uv[corners]) * 2 - 1)[None, None]
    texture = torch.from_numpy(mesh.texture).permute(2, 0, 1)[None] / 255
    picture = torch.zeros(3, *covered.shape)
    picture[:, covered] = grid_sample(texture, places.float(), align_corners=False)[0, :, 0]
    return picture, torch.from_numpy(covered)


def texture_psnr(mesh: Mesh, cameras: list[Camera], surfaces: Surfaces) -> tuple[float, float, float]:
    """Means over the views: PSNR against photos and against renders, and the share of pixels that the mesh covers."""
    found = []
    for camera, (_, surface) in zip(cameras, surfaces.each("Comparing"), strict=True):
        picture, covered = picture_of(mesh, camera)
        others = camera.original_image.cpu(), surface.color.cpu().clamp(0, 1)
        errors = [(picture - other)[:, covered].square().mean().item() for other in others]
        found.append((*(-10 * np.log10(errors)), covered.float().mean().item()))
    return tuple(np.mean(found, axis=0))


def main() -> None:
    """Print the errors of meshes of a model of the demo's scene, and the PSNR of their textures."""
    parser = OptionParser(description=__doc__.splitlines()[0])
    models, pipelines = ModelParams(parser, sentinel=True), PipelineParams(parser, sentinel=True)
    add = parser.add_argument
    add("--voxel", type=float, help="size (default: as export.py)")
    add("--triangles", type=int, nargs="+", default=[200_000, 50_000], help="numbers (default: 200000 50000)")
    args = get_combined_args(parser)
    pipe, scene, things = pipelines.extract(args), load_saved(models.extract(args), -1), demo_scene()
    cameras, splats = scene.getTrainCameras(), splats_of(scene.gaussians, bool(args.antialiasing))
    places, rows = seen_places(things, cameras, PLACES), []
    surfaces = Surfaces(splats, cameras, pipe)
    volume = fuse_volume(surfaces, args.voxel)
    every = extract_zero_level(volume, 1)[:2]
    vertices, faces = keep_whole_parts(*extract_zero_level(volume, CONFIRMED))
    vertices = smooth_rims(vertices, faces)
    meshes = [("one view", *every), ("clean", vertices, faces)]
    meshes += [("clean", *reduce_triangles(vertices, faces, count)) for count in args.triangles]
    for name, *shape in meshes:
        row = [name, f"{len(shape[1]):,}", *(f"{value:.4f}" for value in judge(*shape, things, places).values())]
        if name == "clean":
            start = time.perf_counter()
            mesh = Mesh(*make_texture(*shape, vertex_normals(*shape), surfaces, volume.voxel))
            seconds = time.perf_counter() - start
            photos, renders, covered = texture_psnr(mesh, cameras, surfaces)
            row += [f"{photos:.2f}, {renders:.2f}", f"{100 * covered:.1f}", f"{seconds:.1f}"]
        rows.append([*row, "", "", ""][:10])
    print(describe_machine(compute_device()))
    names = ["accuracy", "95 %", "completeness", "95 %", f"within {CLOSE}", "PSNR: photos, renders", "covered %"]
    print_table(["mesh", "triangles", *names, "seconds of texture"], rows)


if __name__ == "__main__":
    run_cli(main)
