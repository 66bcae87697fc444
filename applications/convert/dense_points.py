"""More points for a scene: patches of photos, found again in other photos at one depth.

Structure from motion keeps the points that suit it, which are too few to begin a training with. Here the poses are
known, so that a patch has to be looked for along its ray alone: over all depths in small photos, then around the best
one in large photos. A point counts if two other photos agree (normalised cross-correlation of patches that face the
camera; a plane sweep, Collins 1996).
"""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch.nn.functional import avg_pool2d, grid_sample

from groundwork.files.color_profiles import to_srgb
from groundwork.files.image_files import open_image
from groundwork.host.progress import Bar, in_threads

SIDE = 800  # pixels of a photo's longer side
_COARSE = 4  # times smaller photos, in which all depths are tried
_DEPTHS, _STEPS = 64, 9  # tried in small and in large photos
_NEAR, _FAR = 0.7, 1.5  # times the depths of a photo's points between which more are looked for
_SPAN = 1000  # largest depth by the least
_PATCH = 3, 2  # pixels beside the middle of a patch, in large and in small photos
_ANGLES = 2.0, 25.0  # degrees between the rays of two photos to the same point
_OTHERS = 4  # photos in which a patch is looked for
_AGREE = 0.85  # correlation of the second best of them
_TEXTURE = 0.02  # least standard deviation of a patch, of full scale
_MOST = 100_000  # patches of all photos together
_EACH = 100, 800  # of a photo, least and most
_AT_ONCE = 32  # photos that are decoded together, with those beside them
_ASKED = 200  # points of a photo that tell its depths


class View(NamedTuple):
    """A pinhole photo: grey pixels (1, 1, H, W) of full scale 1, colours (H, W, 3) uint8, and its camera.

    rotation (3, 3), translation (3,): to the camera, from the world moved to the cameras' middle. intrinsics: (3, 3),
    pixels.
    """

    grey: torch.Tensor
    colors: np.ndarray
    rotation: torch.Tensor
    translation: torch.Tensor
    intrinsics: torch.Tensor


def add_points(folder: Path, shared: Mapping[str, Mapping[str, int]], no_gpu: bool) -> int:
    """Add points without tracks to the model in `sparse` of a folder, whose photos are in `images`; return how many.

    Photos with other cameras than pinholes get none.

    shared: for each photo, the names of other photos and the number of points that both show.
    no_gpu: true to compute on the CPU.
    """
    import pycolmap  # after Pillow

    model = pycolmap.Reconstruction(str(folder / "sparse"))
    if any(camera.model_name not in ("PINHOLE", "SIMPLE_PINHOLE") for camera in model.cameras.values()):
        return 0
    device = torch.device("cuda" if torch.cuda.is_available() and not no_gpu else "cpu")
    points, colors = find_points(model, folder / "images", shared, device)
    for point, color in zip(points, colors, strict=True):
        model.add_point3D(point, pycolmap.Track(), color)
    model.write(str(folder / "sparse"))
    return len(points)


def find_points(
    model: Any, photos: Path, shared: Mapping[str, Mapping[str, int]], device: torch.device
) -> tuple[np.ndarray, np.ndarray]:
    """Find points (N, 3) of a COLMAP model with pinhole cameras, and their colours (N, 3) uint8.

    photos: folder of the model's photos.
    shared: for each photo, the names of other photos and the number of points that both show.
    """
    images = {image.name: image for image in (model.images[number] for number in model.reg_image_ids())}
    each = int(np.clip(_MOST // max(len(images), 1), *_EACH))
    # Far from the origin, as maps are, float32 has few digits left.
    origin = np.mean([image.projection_center() for image in images.values()], axis=0) if images else np.zeros(3)
    depths = {name: _measure_depths(model, image) for name, image in images.items()}
    others = {name: _choose_others(images, name, shared.get(name, {}), depths[name]) for name in sorted(images)}
    names = [name for name, found in others.items() if len(found) >= 2]
    points, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
    views: dict[str, View] = {}
    with Bar(total=len(names), desc="More points", dynamic_ncols=True) as bar:
        for start in range(0, len(names), _AT_ONCE):
            part = names[start : start + _AT_ONCE]
            wanted = sorted({*part, *(other for name in part for other in others[name])})
            views = {name: views[name] for name in wanted if name in views}
            new = [name for name in wanted if name not in views]
            load = partial(_load_view, images, photos, origin, device)
            views |= zip(new, in_threads(load, new, disable=True), strict=True)
            for number, name in enumerate(part, start):
                beside = [views[other] for other in others[name]]
                found, shades = _find_points_of_photo(views[name], beside, depths[name], each, number)
                points.append(found)
                colors.append(shades)
                bar.update()
    return np.concatenate(points) + origin, np.concatenate(colors)


def _measure_depths(model: Any, image: Any) -> np.ndarray:
    """Depths (P,) of some of the points that a photo shows."""
    numbers = image.get_observation_point2D_idxs()
    seen = [image.point2D(number).point3D_id for number in numbers[:: max(len(numbers) // _ASKED, 1)]]
    places, pose = np.array([model.points3D[number].xyz for number in seen]), image.cam_from_world()
    return (places.reshape(-1, 3) @ pose.rotation.matrix().T + pose.translation)[:, 2]


def _choose_others(images: Mapping[str, Any], name: str, shared: Mapping[str, int], depths: np.ndarray) -> list[str]:
    """Choose the photos that share most points with a photo, and see them from another direction."""
    if len(depths) < 3:
        return []
    center, middle = images[name].projection_center(), float(np.median(depths))
    chosen = []
    for other, _ in sorted(shared.items(), key=lambda one: (-one[1], one[0])):
        apart = float(np.linalg.norm(images[other].projection_center() - center)) if other in images else math.inf
        if _ANGLES[0] < math.degrees(2 * math.asin(min(apart / (2 * max(middle, 1e-9)), 1))) < _ANGLES[1]:
            chosen.append(other)
    return chosen[:_OTHERS]


def _load_view(images: Mapping[str, Any], folder: Path, origin: np.ndarray, device: torch.device, name: str) -> View:
    """Load a photo, at most SIDE pixels long, with its pose and intrinsics at that size.

    images: the model's photos by name, each with pose and camera.
    folder: of the photos.
    origin: (3,) point of the world that becomes 0, so that float32 suffices.
    """
    image = images[name]
    with open_image(folder / name) as photo:
        scale = min(1.0, SIDE / max(photo.size))
        size = tuple(round(side * scale) for side in photo.size)
        photo.draft("RGB", size)
        colors = np.asarray(to_srgb(photo).convert("RGB").resize(size))
    intrinsics = torch.tensor(image.camera.calibration_matrix(), dtype=torch.float32)
    intrinsics[:2] *= torch.tensor([[size[0] / image.camera.width], [size[1] / image.camera.height]])
    pose = image.cam_from_world()
    grey = torch.from_numpy(colors.astype(np.float32).mean(2) / 255)[None, None].to(device)
    rotation = pose.rotation.matrix()
    placed = (torch.tensor(part, dtype=torch.float32) for part in (rotation, pose.translation + rotation @ origin))
    return View(grey, colors, *(part.to(device) for part in (*placed, intrinsics)))


def _find_points_of_photo(
    view: View, others: Sequence[View], depths: np.ndarray, count: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) and colours (N, 3) of a photo."""
    pixels = _choose_textured(view.grey, count, seed)  # (P, 2)
    low, high = np.quantile(depths, (0.02, 0.98))
    if high <= 0 or not len(pixels):
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    ends = 1 / (_FAR * high), 1 / (_NEAR * max(low, high / _SPAN))
    steps = torch.linspace(*ends, _DEPTHS, device=pixels.device).expand(len(pixels), -1)
    scores = _measure_agreement(view, others, pixels, steps, _COARSE, _PATCH[1])
    best = scores.argmax(1, keepdim=True)
    width = (ends[1] - ends[0]) / (_DEPTHS - 1)
    fine = steps.gather(1, best) + torch.linspace(-width, width, _STEPS, device=pixels.device)
    scores = _measure_agreement(view, others, pixels, fine.clamp_min(1e-9), 1, _PATCH[0])
    score, best = scores[:, 1:-1].max(1)
    near = torch.stack([scores.gather(1, best[:, None] + k)[:, 0] for k in range(3)])
    bend = (near[0] - 2 * near[1] + near[2]).clamp_max(-1e-6)
    shift = (0.5 * (near[0] - near[2]) / bend).clamp(-1, 1)  # of the parabola through the three
    inverse = fine.gather(1, best[:, None] + 1)[:, 0] + shift * (2 * width / (_STEPS - 1))
    kept = (score > _AGREE) & (inverse > 0)
    rays = _cast_rays(view.intrinsics, pixels[kept] + 0.5)
    points = (rays / inverse[kept, None] - view.translation) @ view.rotation
    columns, rows = pixels[kept].cpu().numpy().astype(int).T
    return points.double().cpu().numpy(), view.colors[rows, columns]


def _choose_textured(grey: torch.Tensor, count: int, seed: int) -> torch.Tensor:
    """Pixels (P, 2), x and y: of each cell of a grid a random one whose patch has texture."""
    radius = _COARSE * _PATCH[1]
    mean, square = (avg_pool2d(part, 2 * _PATCH[0] + 1, 1, _PATCH[0]) for part in (grey, grey**2))
    rough = ((square - mean**2).clamp_min(0).sqrt() > _TEXTURE)[0, 0]
    height, width = rough.shape
    cell = max(2, int(math.sqrt(height * width / count)))
    rng = np.random.default_rng(seed)
    y, x = (np.arange(radius, side - radius, cell) for side in (height, width))
    places = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    places = np.minimum(places + rng.integers(0, cell, places.shape), [width - radius - 1, height - radius - 1])
    places = torch.from_numpy(places).to(grey.device)
    return places[rough[places[:, 1], places[:, 0]]].float()


def _measure_agreement(
    view: View, others: Sequence[View], pixels: torch.Tensor, inverse: torch.Tensor, factor: int, radius: int
) -> torch.Tensor:
    """Return the second best correlation (P, D) of a photo's patches with other photos, at inverse depths (P, D).

    pixels: (P, 2), the middles of the patches.
    inverse: (P, D), 1 / world units.
    factor: by which the photos are made smaller.
    radius: of a patch, in pixels of the smaller photos.
    """
    offsets = torch.arange(-radius, radius + 1, device=pixels.device, dtype=torch.float32) * factor
    offsets = torch.stack(torch.meshgrid(offsets, offsets, indexing="xy"), -1).reshape(-1, 2)
    places = pixels[:, None] + 0.5 + offsets  # (P, K, 2)
    own = _normalize_patches(_sample(view.grey, places[:, None], factor))
    rays = _cast_rays(view.intrinsics, places)[:, None]  # (P, 1, K, 3)
    found = []
    for other in others:
        turn = other.rotation @ view.rotation.T
        along = rays @ (other.intrinsics @ turn).T
        shift = other.intrinsics @ (other.translation - turn @ view.translation)
        x, y, depth = (
            along[..., axis] + shift[axis] * inverse[..., None] for axis in range(3)
        )  # times the inverse depth
        depth = torch.where(depth > 1e-9, depth, torch.nan)  # not what is behind: it is shown nowhere
        found.append(
            (own * _normalize_patches(_sample(other.grey, torch.stack([x / depth, y / depth], -1), factor))).sum(-1)
        )
    return torch.stack(found).topk(2, dim=0).values[1]


def _sample(grey: torch.Tensor, places: torch.Tensor, factor: int) -> torch.Tensor:
    """Values of a photo at places (..., 2) in pixels, whose centres are at .5; beyond its edges 0."""
    height, width = grey.shape[-2:]
    small = avg_pool2d(grey, factor, ceil_mode=True) if factor > 1 else grey
    full = torch.tensor([small.shape[-1] * factor, small.shape[-2] * factor], device=grey.device)
    grid = (2 * places / full - 1).reshape(1, 1, -1, 2).nan_to_num(-9)
    return grid_sample(small, grid, align_corners=False).reshape(places.shape[:-1])


def _normalize_patches(patches: torch.Tensor) -> torch.Tensor:
    """Patches (..., K) of mean 0 and length 1."""
    patches = patches - patches.mean(-1, keepdim=True)
    return patches / patches.norm(dim=-1, keepdim=True).clamp_min(1e-4)


def _cast_rays(intrinsics: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """Rays (..., 3) of depth 1 through places (..., 2) in pixels."""
    flat = (places - intrinsics[:2, 2]) / torch.stack([intrinsics[0, 0], intrinsics[1, 1]])
    return torch.cat([flat, torch.ones_like(flat[..., :1])], -1)
