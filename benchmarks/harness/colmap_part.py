"""A part of a COLMAP scene as a scene of its own."""

from collections.abc import Callable
from pathlib import Path

Choice = Callable[[list], list]


def part(scene: Path, out: Path, photos: Choice, points: Choice = list) -> Path:
    """Write a scene, as text with a link to the photos, and return its folder `out`.

    photos, points: choose from lists of all, by name and by identifier.
    """
    import pycolmap  # after Pillow

    folder = out / "sparse" / "0"
    folder.mkdir(parents=True)
    pycolmap.Reconstruction(str(scene / "sparse" / "0")).write_text(str(folder))
    (out / "images").symlink_to((scene / "images").resolve())
    texts = ((folder / f"{name}.txt").read_text().splitlines() for name in ("images", "points3D"))
    images, rows = ([line for line in text if not line.startswith("#")] for text in texts)
    pairs = sorted(zip(images[::2], images[1::2], strict=True), key=lambda pair: pair[0].split(maxsplit=9)[9])
    rows.sort(key=lambda line: int(line.split(maxsplit=1)[0]))
    (folder / "images.txt").write_text("".join(f"{line}\n" for pair in photos(pairs) for line in pair))
    (folder / "points3D.txt").write_text("".join(f"{line}\n" for line in points(rows)))
    return out


def but_every(number: int, of: list) -> list:
    """All but the first, and every `number`-th after it."""
    return [value for rank, value in enumerate(of) if rank % number]
