"""Photos of a room's corner from known places; its three walls have textures on which features can be found."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from lenses import colmap_camera
from PIL import Image
from scipy.ndimage import map_coordinates, zoom

from scene.images.lens import Lens

SIZE, PANORAMA = (240, 180), (512, 256)
FOCAL = 220.0
FISHEYE = Lens("OPENCV_FISHEYE", (116.0, 116.0, 160.0, 120.0, 0.03, -0.004, 0.001, 0.0), 320, 240)  # 155 degrees


def camera_centers(count: int) -> np.ndarray:
    """Camera positions (count, 3) on an arc that faces the corner at the origin."""
    angles = np.linspace(0.25, 1.3, count)
    return np.stack([4 * np.cos(angles), 4 * np.sin(angles), 1.4 + 0.5 * np.sin(5 * angles)], axis=1)


def make_photos(
    folder: Path,
    count: int,
    suffix: str = ".png",
    panoramas: bool = False,
    focals: Sequence[float] = (FOCAL,),
    lens: Lens | None = None,
    **save: object,
) -> None:
    """Write photo_00, photo_01, ... of SIZE, taken with focal lengths (pixels) by turns, into a folder.

    panoramas: of PANORAMA, which show nothing where there is no wall. lens: another one, with its size, before walls
    whose textures are coarser by the ratio of the focal lengths.
    """
    folder.mkdir(parents=True, exist_ok=True)
    textures = [_texture(seed) for seed in range(3)]
    for number, center in enumerate(camera_centers(count)):
        length = None if panoramas else focals[number % len(focals)]
        picture = Image.fromarray(_photo(center, textures, length, lens))
        picture.save(folder / f"photo_{number:02d}{suffix}", **save)


def _texture(seed: int) -> np.ndarray:
    """Noise (256,256,3) in [0,1], coarse and fine."""
    rng = np.random.default_rng(seed)
    layers = [zoom(rng.random((side, side, 3)), (256 / side, 256 / side, 1), order=1) for side in (16, 64, 128)]
    return np.clip(sum(layers) / 3 * 1.6 - 0.3, 0, 1)


def cam_to_world(center: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) of a camera that looks at the corner from a place; its axes are right, down and forward."""
    forward = np.array([0.0, 0.0, 0.6]) - center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(forward, right), forward])


def _photo(center: np.ndarray, textures: list[np.ndarray], length: float | None, lens: Lens | None) -> np.ndarray:
    panorama = length is None
    width, height = PANORAMA if panorama else (lens.width, lens.height) if lens else SIZE
    right, down, forward = cam_to_world(center).T
    # Four rays per pixel give sharp edges without aliasing.
    y, x = (np.mgrid[: 2 * height, : 2 * width] + 0.5) / 2
    focal = width / (2 * np.pi) if panorama else length
    across, below, ahead = (x - width / 2) / focal, (y - height / 2) / focal, np.ones_like(x)
    if panorama:
        across, below, ahead = np.sin(across) * np.cos(below), np.sin(below), np.cos(across) * np.cos(below)
    if lens:
        local = colmap_camera(lens).cam_ray_from_img(np.column_stack([x.ravel(), y.ravel()]))
        across, below, ahead = local.T.reshape(3, *x.shape)
    rays = sum(along[:, None, None] * part for along, part in ((right, across), (down, below), (forward, ahead)))
    with np.errstate(divide="ignore"):
        distances = np.where(rays < 0, -center[:, None, None] / rays, np.inf)
    wall = np.where(np.isfinite(distances.min(axis=0)), distances.argmin(axis=0), -1)
    hit = center[:, None, None] + rays * distances.min(axis=0)
    texels = 64 * lens.params[0] / FOCAL if lens else 64  # a unit
    colors = np.zeros((2 * height, 2 * width, 3))
    for axis in range(3):
        u, v = (hit[other][wall == axis] * texels for other in range(3) if other != axis)
        for channel in range(3):
            colors[wall == axis, channel] = map_coordinates(
                textures[axis][..., channel], [u, v], order=1, mode="grid-wrap"
            )
    pixels = colors.reshape(height, 2, width, 2, 3).mean(axis=(1, 3))
    return (pixels * 255 + 0.5).astype(np.uint8)
