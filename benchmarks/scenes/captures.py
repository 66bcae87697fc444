"""Sets of photos for convert.py, of real scenes and ray traced, with their true poses where these are known.

    python -m benchmarks.scenes.captures OUT corridor fox_full --scenes DIR

writes OUT/NAME/input with photos, and OUT/NAME/truth, a COLMAP model of them. DIR has the COLMAP scenes bonsai_full,
bonsai_small, fox_full, fox_raw, monstree_raw and monstree_mixed. `bonsai400_2` has every second photo of bonsai_full,
400 pixels wide. Sets that suggest wrong pairs: a `corridor` of equal doors, `two_places` in one folder, photos that are
`mirrored`, photos of a `foreign` scene, and things on a `turntable` before a wall that stays still. Their truth lacks
the photos that have no place beside the others.
"""

import argparse
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from PIL import ExifTags, Image

from splatting.demo.make_scene import write_scene
from splatting.demo.objects import Box, Sphere, Thing, demo_scene, marble
from splatting.demo.tracer import TARGET, View, look_at
from utils.system_utils import UserError, mkdir_p, run_cli

if TYPE_CHECKING:
    import pycolmap

_QUALITY = 95  # of JPEG
_SHAPE = 0.02  # sides of a photo that is smaller than its camera's may differ by that share
_CROP, _TURN = 0.7, 15.0  # of `crops`: share of each side, largest angle in degrees
_LYING = 5  # the first value of EXIF's orientation that exchanges width and height
_TURNS = {3: Image.Transpose.ROTATE_180, 6: Image.Transpose.ROTATE_90, 8: Image.Transpose.ROTATE_270}
_FOX = 269  # width of fox_full's photos, among those of bonsai_small
_SIZE, _POINTS, _SAMPLES = (400, 300), 8000, 2  # of traced sets; rays of a pixel in each direction
_DOOR, _DOORS, _WIDE, _HIGH = 2.0, 24, 1.2, 2.5  # of the corridor, in units; from the middle to a wall
_MARKED = 4  # every so many doors have a mark beside them
_ROOMS = Box((0, -1.25, 0), (2.5, 1.25, 2), 0), Box((5.5, -1.25, 0.2), (2.5, 1.25, 2.2), 0)
_PASSAGE = Box((2.75, -1, 0), (0.5, 1, 0.5), 0)


def photos_of(scene: Path) -> list[Path]:
    """The photos of a COLMAP scene, by name. UserError if it is none."""
    if not (scene / "sparse" / "0").is_dir() or not (scene / "images").is_dir():
        raise UserError(f"{scene} is no COLMAP scene with the folders images and sparse/0; name its folder as --scenes")
    return sorted(path for path in (scene / "images").iterdir() if path.is_file())


def restricted(model: "pycolmap.Reconstruction", photos: Mapping[str, Path]) -> "pycolmap.Reconstruction":
    """The poses and cameras of some photos of a model, and all its points without tracks.

    photos: by their names in the model the files, whose names and sizes they get. Of a file of another shape than its
    camera's, the middle of the camera's picture is left.
    """
    import pycolmap  # after Pillow

    found, numbers = pycolmap.Reconstruction(), {}
    images = {image.name: image for image in model.images.values()}
    for number, (name, path) in enumerate(sorted(photos.items()), 1):
        key = images[name].camera_id, _size(path)
        if key not in numbers:
            numbers[key] = len(numbers) + 1
            found.add_camera_with_trivial_rig(_resized(images[name].camera, key[1], numbers[key]))
        image = pycolmap.Image(name=path.name, camera_id=numbers[key], image_id=number)
        found.add_image_with_trivial_frame(image, images[name].cam_from_world())
    for point in model.points3D.values():
        found.add_point3D(point.xyz, pycolmap.Track(), point.color)
    return found


def _size(path: Path) -> tuple[int, int]:
    """Width and height of a photo as it is displayed."""
    with Image.open(path) as image:
        return image.size[::-1] if image.getexif().get(ExifTags.Base.Orientation, 1) >= _LYING else image.size


def _resized(camera: "pycolmap.Camera", size: tuple[int, int], number: int) -> "pycolmap.Camera":
    import pycolmap

    camera = pycolmap.Camera(camera.todict() | {"camera_id": number})
    across, down = (new / old for new, old in zip(size, (camera.width, camera.height), strict=True))
    if abs(across / down - 1) < _SHAPE:
        camera.rescale(*size)
    else:
        camera.principal_point_x -= (camera.width - size[0]) / 2
        camera.principal_point_y -= (camera.height - size[1]) / 2
        camera.width, camera.height = size
    return camera


def _taken(photos: Sequence[Path], out: Path, width: int = 0, before: str = "") -> dict[str, Path]:
    """Write photos into OUT/input, with a word before their names; return them by the names that they had.

    width: in pixels; 0: the files as they are.
    """
    taken = {path.name: out / "input" / f"{before}{path.name}" for path in photos}
    mkdir_p(out / "input")
    for path in photos:
        if not width:
            shutil.copyfile(path, taken[path.name])
            continue
        with Image.open(path) as image:
            size = width, int(image.height * width / image.width + 0.5)
            image.resize(size, Image.Resampling.LANCZOS).save(taken[path.name], "JPEG", quality=_QUALITY)
    return taken


def _write_truth(scene: Path, out: Path, photos: Mapping[str, Path]) -> None:
    import pycolmap

    mkdir_p(out / "truth")
    restricted(pycolmap.Reconstruction(str(scene / "sparse" / "0")), photos).write_binary(str(out / "truth"))


def thinned(scene: Path, out: Path, every: int, width: int) -> None:
    """Every so many photos of a scene by name, some pixels wide (0: the files as they are), and their truth."""
    _write_truth(scene, out, _taken(photos_of(scene)[::every], out, width))


def crops(scene: Path, out: Path, count: int) -> None:
    """Turned parts of a scene's photos, in the order of these, to measure run time."""
    photos, rng = photos_of(scene), np.random.default_rng(0)
    mkdir_p(out / "input")
    for number in range(count):
        with Image.open(photos[number * len(photos) // count]) as image:
            whole = np.array(image.size)
            size, angle = (whole * _CROP).astype(int), np.radians(rng.uniform(-_TURN, _TURN))
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            room = np.maximum(whole / 2 - np.abs(turn) @ size / 2, 0)
            shift = whole / 2 + rng.uniform(-1, 1, 2) * room - turn @ size / 2
            matrix = np.column_stack([turn, shift]).ravel().tolist()
            part = image.convert("RGB").transform(
                size.tolist(), Image.Transform.AFFINE, matrix, Image.Resampling.BICUBIC
            )
        part.save(out / "input" / f"crop_{number:05d}.jpg", quality=_QUALITY)


def two_places(scene: Path, other: Path, out: Path, width: int) -> None:
    """Photos of two scenes whose names sort apart; the truth is that of the first. width: of the second's photos."""
    _write_truth(scene, out, _taken(photos_of(scene), out, before="a_"))
    _taken(photos_of(other), out, width, before="b_")


def foreign(scene: Path, other: Path, out: Path, count: int, width: int) -> None:
    """A scene's photos and some of another, spread evenly over its names."""
    _write_truth(scene, out, _taken(photos_of(scene), out))
    photos = photos_of(other)
    _taken([photos[k * len(photos) // count] for k in range(count)], out, width, before="foreign_")


def mirrored(scene: Path, out: Path) -> None:
    """A scene's photos, and every third once more with left and right exchanged."""
    _write_truth(scene, out, _taken(photos_of(scene), out))
    for path in _taken(photos_of(scene)[::3], out, before="mirrored_").values():
        with Image.open(path) as image:
            turned = image.transpose(Image.Transpose.FLIP_LEFT_RIGHT)
        turned.save(path, "JPEG", quality=_QUALITY)


def phone(scene: Path, out: Path) -> None:
    """A scene's photos as a phone leaves them: some turned by EXIF, a PNG, a wide crop, a text and a hidden file."""
    taken = _taken(photos_of(scene), out)
    for number, (name, path) in enumerate(taken.items()):
        with Image.open(path) as image:
            image.load()
        if number == 0:
            taken[name] = path.with_suffix(".png")
            image.save(taken[name])
            path.unlink()
        elif number == 1:
            image.crop((0, image.height // 4, image.width, image.height * 3 // 4)).save(path, quality=_QUALITY)
        elif number % 2:
            exif, turn = Image.Exif(), list(_TURNS)[number // 2 % len(_TURNS)]
            exif[ExifTags.Base.Orientation] = turn
            image.transpose(_TURNS[turn]).save(path, exif=exif, quality=_QUALITY)
    _write_truth(scene, out, taken)
    (out / "input" / "notes.txt").write_text("Photos of a tree.\n")
    (out / "input" / ".nomedia").write_bytes(b"")


def grain(p: np.ndarray, seed: int) -> np.ndarray:
    """Colours (3, R) at points (3, R), with details of many sizes, as features need them."""
    rng, total = np.random.default_rng(seed), np.zeros(p.shape, np.float32)
    for weight, scale in ((0.4, 1.0), (0.35, 2.3), (0.25, 5.5)):
        light, dark = (rng.uniform(*of, (3, 1)).astype(np.float32) for of in ((0.6, 1.0), (0.0, 0.4)))
        total += np.float32(weight) * marble(light, dark, int(rng.integers(1000)))(np.float32(scale) * p)
    return total


def _along_corridor(p: np.ndarray) -> np.ndarray:
    """Walls that repeat from door to door, with a mark at some; the ends are bare."""
    x, y, z = p
    place = np.floor(z / np.float32(_DOOR))
    within = z - np.float32(_DOOR) * place
    same = np.stack([x, y, within])
    colour = np.float32(0.45) + np.float32(0.5) * grain(same, 1)
    wall = np.abs(x) > _WIDE - 1e-3
    aside, high = np.abs(within - 1), -y
    frame = wall & (aside < 0.55) & (high < 2.15)
    door = wall & (aside < 0.45) & (high < 2.05)
    colour = np.where(frame, np.float32(0.25), colour)
    colour = np.where(door, np.float32([[0.6], [0.4], [0.25]]) * (np.float32(0.4) + grain(same, 2)), colour)
    mark = wall & (place % _MARKED == 0) & (np.abs(within - 1.8) < 0.15) & (np.abs(high - 1.5) < 0.2)
    colour = np.where(mark, grain(np.float32(3) * p, 3), colour)
    return np.where((z < 1e-3) | (z > _DOOR * _DOORS - 1e-3), np.float32(0.8), colour)


def corridor(_: int | None = None) -> list[Thing]:
    """A tunnel of equal doors."""
    half = _DOOR * _DOORS / 2
    return [Thing(Box((0, -_HIGH / 2, half), (_WIDE, _HIGH / 2, half), 0), _along_corridor, emissive=True)]


def corridor_views(width: int, height: int) -> list[View]:
    """Sixty cameras that walk along the corridor and look ahead and to the right."""
    rng, views = np.random.default_rng(1), []
    for k in range(60):
        center = np.array([rng.uniform(-0.3, 0.1), rng.uniform(-1.6, -1.4), 2.0 + 0.6 * k + rng.uniform(-0.05, 0.05)])
        turn = np.radians(35 + rng.uniform(-6, 6))
        target = center + [np.sin(turn), rng.uniform(-0.05, 0.1), np.cos(turn)]
        views.append(View(look_at(center, target), center, 0.8 * width, width, height))
    return views


class Hollow(NamedTuple):
    """The surface around boxes that overlap, for rays that begin in one of them."""

    boxes: tuple[Box, ...]

    def intersect(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Distances (R,) at which rays leave the last box; as `splatting.demo.objects` has it."""
        end = np.zeros(direction.shape[1], np.float32)
        for box in self.boxes * len(self.boxes):
            leave = box.intersect(origin + end * direction, direction)
            inside = (np.abs(box.local(origin + end * direction)) < 1 + 1e-4).all(0)
            end = np.where(inside & np.isfinite(leave), end + leave, end)
        return np.where(end > 0, end, np.float32(np.inf))


def _of_rooms(p: np.ndarray) -> np.ndarray:
    """Walls of other colours in each room."""
    return np.where(p[0] < _PASSAGE.center[0], grain(p, 4), grain(p, 6))


def rooms(_: int | None = None) -> list[Thing]:
    """Two rooms with furniture at their walls, and a door between them."""
    rng, things = np.random.default_rng(2), []
    things.append(Thing(Hollow((*_ROOMS, _PASSAGE)), _of_rooms, emissive=True))
    for k, room in enumerate(_ROOMS):
        low = rng.uniform(0.2, 0.3)
        places = [(-1.9, -1.4), (-0.8, 1.5), (0.5, -1.5), (1.7, 1.4), (-1.8, 1.4), (1.6, -1.5)]
        for number, (x, z) in enumerate(places):
            x, z, seed = room.center[0] + x, room.center[2] + z, 10 * k + number + 10
            if number % 3 == 2:
                shape = Sphere((x, -0.35, z), 0.35)
            else:
                high = rng.uniform(0.3, 0.8)
                shape = Box((x, -high, z), (0.4, high, 0.3), rng.uniform(-0.4, 0.4))
            things.append(Thing(shape, lambda p, seed=seed: grain(p, seed)))
        table = Box((room.center[0], -low, room.center[2]), (0.5, low, 0.3), 0.2)
        things.append(Thing(table, lambda p, k=k: grain(p, 40 + k)))
    return things


def rooms_views(width: int, height: int) -> list[View]:
    """Forty cameras in each room, which look across it, and ten on the way through the door."""
    rng, views = np.random.default_rng(3), []

    def add(center: np.ndarray, target: np.ndarray) -> None:
        center, target = center + rng.uniform(-0.05, 0.05, 3), target + rng.uniform(-0.1, 0.1, 3)
        views.append(View(look_at(center, target), center, 0.7 * width, width, height))

    def around(room: Box) -> None:
        middle = np.array([room.center[0], -1.3, room.center[2]])
        for angle in 2 * np.pi * np.arange(40) / 40:
            out = np.array([1.5 * np.cos(angle), 0, 0.7 * np.sin(angle)])
            add(middle + out, middle - out + [0, 0.3, 0])

    around(_ROOMS[0])
    for x in np.linspace(-1.0, 5.0, 10):
        add(np.array([x, -1.3, 0]), np.array([x + 2, -1.2, 0.05]))
    around(_ROOMS[1])
    return views


def ring(count: int, width: int, height: int) -> list[View]:
    """Cameras around the demo's things, at heights that rise and fall; the last one stands before the first."""
    views = []
    for angle in 2 * np.pi * np.arange(count) / count:
        tilt = np.radians(24 + 8 * np.sin(2 * angle))
        out = np.array([np.cos(tilt) * np.sin(angle), -np.sin(tilt), np.cos(tilt) * np.cos(angle)])
        center = TARGET + 3.8 * out
        views.append(View(look_at(center, TARGET), center, 0.9 * width, width, height))
    return views


def turntable_views(width: int, height: int) -> list[View]:
    """Forty cameras around the turntable."""
    return ring(40, width, height)


def turntable(photo: int | None) -> list[Thing]:
    """The demo's things without sky and ground; in a photo, before a wall that turns with its camera."""
    things = demo_scene()[2:]
    if photo is None:
        return things
    view = turntable_views(1, 1)[photo]

    def still(p: np.ndarray) -> np.ndarray:
        local = view.rotation.astype(np.float32) @ (p - view.center.astype(np.float32)[:, None])
        return grain(np.float32(5) * local / np.maximum(local[2], np.float32(1)), 5)

    return [Thing(Sphere(tuple(view.center), 20.0, inside=True), still, emissive=True), *things]


def demo(_: int | None) -> list[Thing]:
    """The demo's things, once for each photo."""
    return demo_scene()


def video_views(width: int, height: int) -> list[View]:
    """The cameras of a video's frames, once around."""
    return ring(300, width, height)


TRACED = {
    "corridor": (corridor_views, corridor),
    "rooms": (rooms_views, rooms),
    "turntable": (turntable_views, turntable),
    "video": (video_views, demo),
}


def traced(name: str, out: Path, size: tuple[int, int] = _SIZE) -> None:
    """Ray-trace a set of TRACED. That of the video has its frames apart, as names of its truth."""
    views, things = TRACED[name]
    write_scene(out, views(*size), things, _POINTS, np.random.default_rng(0), _SAMPLES)
    (out / "sparse" / "0").rename(out / "truth")
    (out / "sparse").rmdir()
    if name == "video":
        _write_video(out)
    else:
        (out / "images").rename(out / "input")


def _write_video(out: Path) -> None:
    """Write video.mp4 of the images, which become frames/frame_00001.png, ..., and name them so in the truth."""
    import imageio_ffmpeg
    import pycolmap

    (out / "frames").mkdir()
    frames, writer = {}, None
    for number, path in enumerate(sorted((out / "images").iterdir()), 1):
        frames[path.name] = path.rename(out / "frames" / f"frame_{number:05d}.png")
        with Image.open(frames[path.name]) as image:
            if writer is None:
                writer = imageio_ffmpeg.write_frames(
                    str(out / "video.mp4"), image.size, fps=30, quality=9, macro_block_size=2
                )
                writer.send(None)
            writer.send(image.convert("RGB").tobytes())
    writer.close()
    (out / "images").rmdir()
    restricted(pycolmap.Reconstruction(str(out / "truth")), frames).write_binary(str(out / "truth"))


SETS: dict[str, Callable[[Path, Path], None]] = {
    # Photos of bonsai_full are 800 pixels wide.
    **{
        f"bonsai{width}_{every}": lambda scenes, out, width=width, every=every: thinned(
            scenes / "bonsai_full", out, every, 0 if width == 800 else width
        )
        for width, every in ((400, 1), (400, 2), (800, 1), (800, 2), (800, 4), (3200, 1))
    },
    **{
        name: lambda scenes, out, name=name: thinned(scenes / name, out, 1, 0)
        for name in ("fox_full", "fox_raw", "monstree_raw", "bonsai_small")
    },
    **{
        f"crops{count}": lambda scenes, out, count=count: crops(scenes / "bonsai_full", out, count)
        for count in (375, 1500)
    },
    **{name: lambda _, out, name=name: traced(name, out) for name in TRACED},
    "two_places": lambda scenes, out: two_places(scenes / "bonsai_small", scenes / "fox_full", out, _FOX),
    "mirrored": lambda scenes, out: mirrored(scenes / "bonsai_small", out),
    "foreign": lambda scenes, out: foreign(scenes / "bonsai_small", scenes / "fox_full", out, 20, _FOX),
    "phone": lambda scenes, out: phone(scenes / "monstree_mixed", out),
}


def make(name: str, scenes: Path, out: Path) -> Path:
    """Write a set of SETS to OUT/NAME, which appears only when it is complete, and return that folder.

    scenes: folder of the COLMAP scenes. A set that is there stays.
    """
    folder, work = out / name, out / f".{name}.{os.getpid()}.tmp"
    if not folder.exists():
        mkdir_p(out)
        try:
            SETS[name](scenes, work)
            work.rename(folder)
        finally:
            shutil.rmtree(work, ignore_errors=True)
    return folder


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="folder for the sets")
    parser.add_argument("names", nargs="+", choices=SETS, metavar="NAME", help=f"sets to make: {', '.join(SETS)}")
    parser.add_argument("--scenes", type=Path, default=Path(), metavar="DIR", help="folder of COLMAP scenes")
    args = parser.parse_args()
    for name in args.names:
        if (args.out / name).exists():
            raise UserError(f"{args.out / name} exists; name another folder")
        make(name, args.scenes, args.out)


if __name__ == "__main__":
    run_cli(main)
