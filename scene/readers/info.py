"""Plain records that readers of datasets return, and the size and frame of a scene.

Nothing here decodes photos, uses a GPU or writes a file. float32 has steps of 0.06 at 1e6: a scene whose coordinates
are large compared with its extent, as in map projections (UTM), is trained as world minus an offset, which is computed
and subtracted in double.
"""

import math
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, FrozenInstanceError, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from diff_gaussian_rasterization.lens import Lens as NativeLens

from scene.images.decode import picture_size
from scene.images.lens import Lens
from scene.images.masks import Mask
from scene.images.store import Decodable, InMemory
from utils.graphics_utils import BasicPointCloud, camera_center, focal2fov, fov2focal, rigid_pose
from utils.system_utils import UserError

HOLD = 8  # every 8th photo by name is a test view (Mip-NeRF 360's split)
NEAREST = 0.2  # depth from which Gaussians are drawn (the rasterizer's rule)
APART = 10.0  # median distances from the cameras' median, beyond which a camera stands apart
NARROW = 1e-2  # of the depth; with a smaller E, removing Gaussians wider than 0.1 E would leave only pixel-sized ones
_UNTURNED = 0.05  # weight of the photos' own upward axes where their sideward axes do not tell what is up
ROUNDING = 1e-9  # distances below this part of the scene are rounding errors
# Extents from the origin. There a step of float32 is a hundred-thousandth of the extent, many times the moves of
# positions in the last iterations (1.6e-6 extents and less).
FARTHEST = 100.0


class _LikeNamedTuple:
    """The methods of a named tuple of `_fields`, which are the reference's; further fields have names only.

    Fields of the tuple are not assigned to. As a named tuple, a subclass may make itself in a `__new__` of its own.
    """

    _fields: ClassVar[tuple[str, ...]]
    _fill: ClassVar[Callable[..., None] | None] = None  # of such a subclass: the __init__ that its __new__ stands for

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if "__new__" in vars(cls) and cls._fill is None:
            cls._fill, cls.__init__ = cls.__init__, lambda *_, **__: None

    def __new__(cls, *args: Any, **kwargs: Any) -> "_LikeNamedTuple":
        made = super().__new__(cls)
        if cls._fill is not None:
            made._fill(*args, **kwargs)
        return made

    def __getnewargs__(self) -> tuple:
        return tuple(self)

    def __setattr__(self, name: str, value: Any) -> None:
        if name in self._fields and name in vars(self):
            raise FrozenInstanceError(f"{name} is a field of a {type(self).__name__}: make another one by _replace")
        object.__setattr__(self, name, value)

    def _asdict(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in self._fields}

    def __iter__(self) -> Iterator[Any]:
        return iter(self._asdict().values())

    def __len__(self) -> int:
        return len(self._fields)

    def __getitem__(self, index: int | slice) -> Any:
        return tuple(self)[index]


class Posed(NamedTuple):
    """A photo with a pose. file: as it is listed. R (3,3): camera-to-world rotation; T (3,): world-to-camera
    translation; y down and z forward. lens: of a photo of a size (width, height).
    """

    file: str
    R: np.ndarray
    T: np.ndarray
    lens: Callable[[tuple[int, int]], Lens]


@dataclass(eq=False)
class CameraInfo(_LikeNamedTuple):
    """One view. The fields up to is_test are the reference's; the others are given by name.

    uid: COLMAP's camera (intrinsics) id, or the frame's index. R (3,3): camera-to-world rotation; T (3,):
    world-to-camera translation; both without a scale (`rigid_pose`). FovY, FovX: opening angles in radians of a frustum
    of the image's size. depth_params, depth_path: scale, offset and the scene's median scale (med_scale) of an inverse
    depth map, and its file; None and "" without a map. image_name: COLMAP's full name, or the file's stem. width,
    height: of the image that the intrinsics belong to. is_test: a held-out view.

    fx, fy, cx, cy: pixels of that image, pixel centres at .5. Either FovX and FovY or fx and fy must be given; the
    others follow from them. Where they disagree, fx and fy count. The principal point is the middle by default.
    file_size: (width, height) of the photo, None: not read yet. lens: of a photo that has to be undistorted first, else
    None (scene/readers/photos.py). native: the lens of a photo that is taken as it is; fx, fy, cx and cy are then
    those of its axis. mask: of the photo's shape, None if all pixels count. ignore_alpha: transparent pixels of the
    photo do not count. opaque: the photo's alpha is dropped. depth: inverse depth of a training view that has a map
    (scene/readers/depth_maps.py). lying: the photo's own file, where image_path is its upright copy
    (scene/readers/photos.py). image: the photo in memory, which readers leave out: a PIL image, as the 2023 release
    gave it, or pixels at training size.
    """

    uid: int
    R: np.ndarray
    T: np.ndarray
    FovY: float | None = None
    FovX: float | None = None
    depth_params: Mapping[str, float] | None = None
    image_path: str | Path = ""
    image_name: str = ""
    depth_path: str = ""
    width: int = 0
    height: int = 0
    is_test: bool = False
    _: KW_ONLY
    fx: float | None = None
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    file_size: tuple[int, int] | None = None
    lens: Lens | None = None
    native: NativeLens | None = None
    mask: Mask | None = None
    ignore_alpha: bool = False
    opaque: bool = False
    depth: Decodable | InMemory | None = None
    lying: Path | None = None
    image: Any = None

    def __post_init__(self) -> None:
        """Divide a scale out of R and T, and compute fields that follow from others."""
        values = vars(self)
        values["R"], values["T"] = rigid_pose(self.R, self.T, self.image_name)
        for fov, focal, center, side in _AXES:
            size, angle, length = values[side], values[fov], values[focal]
            if not size or (angle is None and length is None):
                raise TypeError(f"a CameraInfo needs {side}, and {fov} or {focal}")
            if length is None:
                values[focal] = fov2focal(angle, size)
            elif angle is None or not math.isclose(angle, focal2fov(length, size), rel_tol=_SAME_ANGLE):
                values[fov] = focal2fov(length, size)
            if values[center] is None:
                values[center] = size / 2

    def _replace(self, **changes: Any) -> "CameraInfo":
        """A copy with some fields changed, and with those that follow from them.

        A change of FovX changes fx, and the other way round. A change of width keeps FovX, as in the reference, and the
        principal point's place in the image. Another photo has its own file_size. Likewise for the vertical.
        """
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        for fov, focal, center, side in _AXES:
            if fov in changes or side in changes:
                values[focal] = None
            elif focal in changes:
                values[fov] = None
            if side in changes:
                values[center] *= changes[side] / values[side]
        if {"image_path", "image"} & set(changes):
            values["file_size"] = None
        return type(self)(**{**values, **changes})

    @property
    def center(self) -> np.ndarray:
        """Camera centre (3,) in the world."""
        return camera_center(self.R, self.T)


def as_camera_info(view: Any) -> CameraInfo:
    """A record of other code with the reference's fields, and what follows from them."""
    if type(view) is CameraInfo:
        return view
    names = {one.name for one in fields(CameraInfo)} - {"fx", "fy", "lens"}
    values = {name: getattr(view, name) for name in names if hasattr(view, name)}
    values |= {name: float(values[name]) for name in ("cx", "cy") if values.get(name) is not None}
    if not isinstance(values.get("mask"), Mask):
        values["mask"] = None  # an attribute of other code by that name
    return CameraInfo(**values)


_SAME_ANGLE = 1e-9  # relative; FovX, turned into fx and back, differs by rounding
_AXES = (("FovX", "fx", "cx", "width"), ("FovY", "fy", "cy", "height"))


@dataclass(eq=False)
class SceneInfo(_LikeNamedTuple):
    """A dataset: start cloud (None if not wanted), views, their size, and the cloud's PLY if it has one.

    nerf_normalization: "radius", the extent E in world units, and "translate" (3,), minus the cameras' centre.
    is_nerf_synthetic: a Blender scene. offset (3,) float64: the world's coordinates of the frame's origin
    (`world_offset`); zero by default. has_random_points: nobody has given points, so the reader has made some.
    """

    point_cloud: BasicPointCloud | None
    train_cameras: list[CameraInfo]
    test_cameras: list[CameraInfo]
    nerf_normalization: Mapping[str, Any]
    ply_path: str | Path | None
    is_nerf_synthetic: bool = False
    _: KW_ONLY
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    has_random_points: bool = False

    def _replace(self, **changes: Any) -> "SceneInfo":
        """A copy with some fields changed."""
        return replace(self, **changes)

    @property
    def extent(self) -> float | None:
        """The extent E in world units; None where other code has made the record without one."""
        radius = self.nerf_normalization["radius"]
        return None if radius is None else float(radius)


for record in (CameraInfo, SceneInfo):
    record._fields = tuple(item.name for item in fields(record) if not item.kw_only)


def photo_size(view: CameraInfo) -> tuple[int, int]:
    """Size (width, height) of the photo of a record. Where it cannot be read, a CameraInfo's own; else UserError."""
    size, image = getattr(view, "file_size", None), getattr(view, "image", None)
    if size or image is not None:
        return size or image.size
    try:
        return picture_size(Path(view.image_path))
    except UserError:
        if not isinstance(view, CameraInfo):
            raise
        return view.width, view.height


def are_exchanged(photo: tuple[int, int], camera: tuple[int, int]) -> bool:
    """Tell whether a photo's size (width, height) is a camera's with width and height exchanged, at any scale."""
    (width, height), (w, h) = photo, camera
    return abs(width * w / h - height) <= 1 < abs(width * h / w - height)


def describe_exchanged_sides(
    names: Sequence[str], count: int, photo: tuple[int, int], camera: tuple[int, int]
) -> tuple[str, str]:
    """Describe photos, the first of these sizes, of `count`, whose sides are exchanged; also return the remedy."""
    size, other = (f"{width} x {height}" for width, height in (photo, camera))
    return (
        f"{len(names)} of {count} photos have the sides of their camera exchanged, the first {names[0]} ({size}, "
        f"camera {other})",
        "turn the photos, or exchange width and height of the camera"
        + (", or restore the names of these photos" if len(names) < count else ""),
    )


def exposure_names(cameras: Sequence[CameraInfo]) -> list[str]:
    """A unique name for each view: its image name, or its path from the views' common folder if several share the name,
    as Blender's train/r_0 and test/r_0 do. A view without a path keeps its name.
    """
    names = [camera.image_name for camera in cameras]
    shared = {name for name, count in Counter(names).items() if count > 1}
    if not shared:
        return names
    paths = [Path(getattr(camera, "lying", None) or getattr(camera, "image_path", None) or "") for camera in cameras]
    folder = os.path.commonpath([path.parent for path in paths if path.name] or [""])
    return [
        os.path.relpath(path, folder) if name in shared and path.name else name
        for name, path in zip(names, paths, strict=True)
    ]


def photo_names(cam_infos: Sequence[Any]) -> list[str]:
    """A name for each camera's exposure. Cameras of one name need an `image_path`, or they share an exposure."""
    names = [camera.image_name for camera in cam_infos]
    if len(set(names)) == len(names):
        return names
    return exposure_names(cam_infos) if all(hasattr(c, "image_path") for c in cam_infos) else list(dict.fromkeys(names))


def places(names: Any, among: Sequence[str]) -> list[int] | None:
    """Indices of names, as of an earlier training's photos, among others; None unless all are there, each once."""
    rows = {name: row for row, name in enumerate(among)}
    if not isinstance(names, list) or not all(isinstance(name, str) and name in rows for name in names):
        return None
    return [rows[name] for name in names] if len({*names}) == len(names) else None


def names_of_photos(info: SceneInfo) -> dict[str, str]:
    """`exposure_names` of the training views by the paths of their photos."""
    return dict(zip([view.image_path for view in info.train_cameras], exposure_names(info.train_cameras), strict=True))


def normalization(cameras: Sequence[CameraInfo], points: np.ndarray | None = None) -> dict[str, Any]:
    """`SceneInfo.nerf_normalization` of the training views: the radius is `scene_extent`."""
    centers = camera_centers(cameras)
    return {"translate": -centers[~outliers(centers)].mean(axis=0), "radius": scene_extent(cameras, points)}


def camera_centers(cameras: Sequence[CameraInfo]) -> np.ndarray:
    """Camera centres (N,3) in the world, of any records with R and T."""
    return np.array([camera_center(camera.R, camera.T) for camera in cameras])


def up_of(rotations: np.ndarray) -> np.ndarray:
    """Estimate the up direction (3,) of a scene from rotations (N,3,3) from camera to world axes.

    Photographers hold cameras level: up is perpendicular to the cameras' x axes, as far as these differ.
    """
    sideward, upward = rotations[:, :, 0], -rotations[:, :, 1].mean(0)
    up = np.linalg.solve(sideward.T @ sideward / len(rotations) + _UNTURNED * np.eye(3), upward)
    return up / max(np.linalg.norm(up), 1e-12)


def from_above(up: np.ndarray) -> np.ndarray:
    """Axes (2,3) of a picture from above: perpendicular to `up` (3,), the second a quarter turn counter-clockwise."""
    up = up / max(float(np.linalg.norm(up)), 1e-9)
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    first /= max(float(np.linalg.norm(first)), 1e-9)
    return np.stack([first, np.cross(up, first)])


def scene_extent(cameras: Sequence[CameraInfo], points: np.ndarray | None = None) -> float:
    """Extent E: 1.1 times the largest distance of a camera from the cameras' mean, in world units.

    Outlying cameras (`outliers`) are left out. If the cameras are nearly in one place (E below NARROW
    times the depth), E is 1.1 times the median depth of the points (N,3) in front of the first camera. Without such
    points it is then 1.
    """
    centers = camera_centers(cameras)
    counted = ~outliers(centers)
    centers, first = centers[counted], cameras[counted.argmax()]
    extent = 1.1 * float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    points = np.zeros((0, 3)) if points is None else points
    depths = (points @ first.R + first.T)[:, 2]
    depths = depths[depths > 0]
    if not len(depths):
        return extent if extent > ROUNDING * (1 + np.abs(centers).max()) else 1.0
    fallback = 1.1 * float(np.median(depths))
    return extent if extent > NARROW * fallback else fallback


def outliers(centers: np.ndarray) -> np.ndarray:
    """Mark camera centres (N,3) farther than APART times the median distance from their median: (N,) bool."""
    distances = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    median = float(np.median(distances))
    # If most cameras are in one place, up to rounding, the others are no mistake.
    return distances > (APART * median if median > ROUNDING * distances.max() else np.inf)


def world_offset(info: SceneInfo) -> np.ndarray:
    """Offset (3,) float64: round decimal numbers near a scene that is far from its origin, else zero."""
    cameras = info.train_cameras + info.test_cameras
    middle = np.median([camera.center for camera in cameras], axis=0)
    return origin_near(middle, scene_extent(cameras, None if info.point_cloud is None else info.point_cloud.points))


def origin_near(middle: np.ndarray, extent: float) -> np.ndarray:
    """Round decimal numbers (3,) near the middle of something of an extent, zero if that is not far away."""
    if np.abs(middle).max() <= FARTHEST * extent:
        return np.zeros(3)
    step = 10.0 ** np.ceil(np.log10(10 * extent))
    return np.round(middle / step) * step


def local(info: SceneInfo, offset: np.ndarray) -> SceneInfo:
    """Move the scene into the frame whose origin is `offset` (3,) of the world; points become float32."""
    moved = bool(np.any(offset))
    train, test = info.train_cameras, info.test_cameras
    if moved:
        train, test = ([_move_camera(camera, offset) for camera in cameras] for cameras in (train, test))
    cloud, points = info.point_cloud, None
    if cloud is not None:
        with np.errstate(over="ignore"):  # the points become infinite, which start_rows refuses
            points = (cloud.points - offset if moved else cloud.points).astype(np.float32)
        cloud = BasicPointCloud(points, cloud.colors, cloud.normals)
    size = normalization(train, points)
    return replace(
        info, point_cloud=cloud, train_cameras=train, test_cameras=test, nerf_normalization=size, offset=offset
    )


def _move_camera(camera: CameraInfo, offset: np.ndarray) -> CameraInfo:
    return replace(camera, T=camera.T + camera.R.T @ offset)
