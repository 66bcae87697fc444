"""Poses and lenses that are given (--poses): those of a transforms.json, or of a COLMAP model, for the photos here."""

import sys
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from applications.convert.layout import FEWEST, Layout
from groundwork.files.image_files import SUFFIXES
from groundwork.files.json_files import read_json, write_json
from scene.images.decode import picture_size
from scene.images.find import FileIndex
from scene.images.lens import Lens, pinhole_of
from scene.readers import colmap, transforms
from scene.readers.info import Posed
from utils.graphics_utils import rigid_pose
from utils.system_utils import UserError

_ROUNDED = 1.5  # pixels by which a smaller copy's side may differ from the camera's proportions


def list_pose_files(source: Path) -> list[Path]:
    """List the files that contain the poses: a camera file, or those of a model's folder. UserError without any."""
    if source.is_file():
        return [source]
    files = sorted(path for path in source.glob("*") if path.stem in ("cameras", "images")) if source.is_dir() else []
    if not files:
        raise UserError(
            f"no poses in {source}; pass a transforms.json, or the folder of cameras.txt and images.txt (or .bin) of a "
            "COLMAP model, as --poses"
        )
    return files


def write_given(layout: Layout, source: Path) -> None:
    """Write `layout.given`, the poses and cameras of the prepared photos. `find_posed_photos` has the errors."""
    cameras: dict[tuple[Lens, tuple[int, int]], int] = {}
    images = []
    for name, posed, lens, size in find_posed_photos(layout, source):
        rotation, translation = rigid_pose(posed.R, posed.T, name)
        number = cameras.setdefault((lens, size), len(cameras) + 1)
        pose = [[*row, shift] for row, shift in zip(rotation.T.tolist(), translation.tolist(), strict=True)]
        images.append({"name": name, "camera": number, "pose": pose})
    content = [{**lens._asdict(), "size": size} for lens, size in cameras]
    write_json(layout.given, {"cameras": content, "images": images})


def find_posed_photos(layout: Layout, source: Path) -> list[tuple[str, Posed, Lens, tuple[int, int]]]:
    """Find the prepared photos that have a pose; return name, pose, lens and size of each.

    UserError for poses, lenses or names that cannot be used, and for cameras whose proportions are not the photos'.
    """
    poses = (colmap if source.is_dir() else transforms).read_poses(source)
    found = _index_by_photo(layout.prepared, poses, source)
    if len(found) < FEWEST:
        listed = f", which lists {poses[0].file} first" if poses else ""
        raise UserError(
            f"{len(found)} photos of {layout.input} have a pose in {source}{listed}; put the photos there under the "
            "names that they have in the file"
        )
    if len(found) < len(poses):
        print(f"{len(poses) - len(found)} poses of {source} have no photo and are not used", file=sys.stderr)
    photos = []
    for name, posed in sorted(found.items()):
        size = picture_size(layout.prepared / name)
        lens = posed.lens(size)
        pinhole_of(lens, name)  # UserError for a lens that is unusable
        if abs(size[0] * lens.height / lens.width - size[1]) > _ROUNDED:
            raise UserError(
                f"the photo {name} has {size[0]} x {size[1]} pixels when it is upright, but its camera in {source} has "
                f"{lens.width} x {lens.height}; use the photos that the poses were made for"
            )
        photos.append((name, posed, lens, size))
    return photos


def list_given(layout: Layout) -> list[str]:
    """List the photos of `layout.given`, in order."""
    return [image["name"] for image in read_json(layout.given)["images"]]


def _index_by_photo(folder: Path, poses: Sequence[Posed], source: Path) -> dict[str, Posed]:
    """Return the poses by the names of their photos. UserError where two poses are of one photo."""
    index, found = FileIndex(folder), {}
    for posed in poses:
        parts = PurePosixPath(posed.file.replace("\\", "/")).parts
        names = ["/".join(parts[start:]) for start in range(len(parts))]  # a file may name further folders
        path = index.find(*names, *(name + suffix for name in names for suffix in SUFFIXES))
        alike = [] if path else [match for name in names for match in index.with_another_suffix(name)]
        if path or len(alike) == 1:
            name = (path or alike[0]).relative_to(folder).as_posix()
            if name in found:
                raise UserError(
                    f"{found[name].file} and {posed.file} in {source} are both of the photo {name}; leave one of them"
                )
            found[name] = posed
    return found
