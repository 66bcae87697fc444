"""Sets of photos for convert.py, of real scenes and ray traced, with their true poses where these are known.

    python -m benchmarks.scenes.captures OUT corridor fox_full --scenes DIR

writes OUT/NAME/input with photos, and OUT/NAME/truth, a COLMAP model of them. DIR has the COLMAP scenes tt_train,
bonsai_full, bonsai_small, fox_full, fox_raw, monstree_raw and monstree_mixed. `bonsai400_2` has every second photo of
bonsai_full, 400 pixels wide. Sets that suggest wrong pairs: a `corridor` of equal doors, `two_places` in one folder,
two rooms with one `poster`, a `twin_box`, photos that are `mirrored`, photos of a `foreign` scene, and things on a
`turntable` before a wall that stays still. Their truth lacks the photos that have no place beside the others. The
camera of `turning3` only turns, with 3 cm of noise.
"""

import argparse
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import ExifTags, Image

from applications.demo.make_scene import write_scene
from benchmarks.scenes.traced import TRACED
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


def list_photos(scene: Path) -> list[Path]:
    """The photos of a COLMAP scene, by name. UserError if it is none."""
    if not (scene / "sparse" / "0").is_dir() or not (scene / "images").is_dir():
        raise UserError(f"{scene} is no COLMAP scene with the folders images and sparse/0; name its folder as --scenes")
    return sorted(path for path in (scene / "images").iterdir() if path.is_file())


def restrict_model(model: "pycolmap.Reconstruction", photos: Mapping[str, Path]) -> "pycolmap.Reconstruction":
    """The poses and cameras of some photos of a model, and all its points without tracks.

    photos: by their names in the model the files, whose names and sizes they get. Of a file of another shape than its
    camera's, the middle of the camera's picture is left.
    """
    import pycolmap  # after Pillow

    found, numbers = pycolmap.Reconstruction(), {}
    images = {image.name: image for image in model.images.values()}
    for number, (name, path) in enumerate(sorted(photos.items()), 1):
        key = images[name].camera_id, _read_size(path)
        if key not in numbers:
            numbers[key] = len(numbers) + 1
            found.add_camera_with_trivial_rig(_resize_camera(images[name].camera, key[1], numbers[key]))
        image = pycolmap.Image(name=path.name, camera_id=numbers[key], image_id=number)
        found.add_image_with_trivial_frame(image, images[name].cam_from_world())
    for point in model.points3D.values():
        found.add_point3D(point.xyz, pycolmap.Track(), point.color)
    return found


def _read_size(path: Path) -> tuple[int, int]:
    """Width and height of a photo as it is displayed."""
    with Image.open(path) as image:
        return image.size[::-1] if image.getexif().get(ExifTags.Base.Orientation, 1) >= _LYING else image.size


def _resize_camera(camera: "pycolmap.Camera", size: tuple[int, int], number: int) -> "pycolmap.Camera":
    """Return a camera of another size (width, height): rescaled, or cropped if the shape is another one.

    number: camera_id of the result.
    """
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


def _write_photos(photos: Sequence[Path], out: Path, width: int = 0, before: str = "") -> dict[str, Path]:
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
    restrict_model(pycolmap.Reconstruction(str(scene / "sparse" / "0")), photos).write_binary(str(out / "truth"))


def make_thinned(scene: Path, out: Path, every: int, width: int) -> None:
    """Every so many photos of a scene by name, some pixels wide (0: the files as they are), and their truth."""
    _write_truth(scene, out, _write_photos(list_photos(scene)[::every], out, width))


def make_crops(scene: Path, out: Path, count: int) -> None:
    """Turned parts of a scene's photos, in the order of these, to measure run time."""
    photos, rng = list_photos(scene), np.random.default_rng(0)
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
                tuple(size.tolist()), Image.Transform.AFFINE, matrix, Image.Resampling.BICUBIC
            )
        part.save(out / "input" / f"crop_{number:05d}.jpg", quality=_QUALITY)


def make_two_places(scene: Path, other: Path, out: Path, width: int) -> None:
    """Photos of two scenes whose names sort apart; the truth is that of the first. width: of the second's photos."""
    _write_truth(scene, out, _write_photos(list_photos(scene), out, before="a_"))
    _write_photos(list_photos(other), out, width, before="b_")


def make_foreign(scene: Path, other: Path, out: Path, count: int, width: int) -> None:
    """A scene's photos and some of another, spread evenly over its names."""
    _write_truth(scene, out, _write_photos(list_photos(scene), out))
    photos = list_photos(other)
    _write_photos([photos[k * len(photos) // count] for k in range(count)], out, width, before="foreign_")


def make_mirrored(scene: Path, out: Path) -> None:
    """A scene's photos, and every third once more with left and right exchanged."""
    _write_truth(scene, out, _write_photos(list_photos(scene), out))
    for path in _write_photos(list_photos(scene)[::3], out, before="mirrored_").values():
        with Image.open(path) as image:
            turned = image.transpose(Image.Transpose.FLIP_LEFT_RIGHT)
        turned.save(path, "JPEG", quality=_QUALITY)


def make_phone(scene: Path, out: Path) -> None:
    """A scene's photos as a phone leaves them: some turned by EXIF, a PNG, a wide crop, a text and a hidden file."""
    taken = _write_photos(list_photos(scene), out)
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


def make_traced(name: str, out: Path, size: tuple[int, int] = _SIZE) -> None:
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
    restrict_model(pycolmap.Reconstruction(str(out / "truth")), frames).write_binary(str(out / "truth"))


SETS: dict[str, Callable[[Path, Path], None]] = {
    # Photos of bonsai_full are 800 pixels wide.
    **{
        f"bonsai{width}_{every}": lambda scenes, out, width=width, every=every: make_thinned(
            scenes / "bonsai_full", out, every, 0 if width == 800 else width
        )
        for width, every in ((400, 1), (400, 2), (800, 1), (800, 2), (800, 4), (3200, 1))
    },
    **{
        name: lambda scenes, out, name=name: make_thinned(scenes / name, out, 1, 0)
        for name in ("tt_train", "fox_full", "fox_raw", "monstree_raw", "bonsai_small")
    },
    **{
        f"crops{count}": lambda scenes, out, count=count: make_crops(scenes / "bonsai_full", out, count)
        for count in (375, 1500)
    },
    **{name: lambda _, out, name=name: make_traced(name, out) for name in TRACED},
    "two_places": lambda scenes, out: make_two_places(scenes / "bonsai_small", scenes / "fox_full", out, _FOX),
    "mirrored": lambda scenes, out: make_mirrored(scenes / "bonsai_small", out),
    "foreign": lambda scenes, out: make_foreign(scenes / "bonsai_small", scenes / "fox_full", out, 20, _FOX),
    "phone": lambda scenes, out: make_phone(scenes / "monstree_mixed", out),
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
    """Make the sets that the command line names."""
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
