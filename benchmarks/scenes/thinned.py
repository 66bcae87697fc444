"""A COLMAP scene with few photos to train on, without the points that judge the depth.

    python -m benchmarks.scenes.thinned SCENE OUT --keep 3

Every so many of the training photos stay. Photos get new names, so that a test photo stands before seven of them, where
--eval holds it out. Scores on all test photos of SCENE, with their depth, come from benchmarks.scenes.scores.
"""

import argparse
from pathlib import Path

from benchmarks.harness.colmap_part import but_every, part
from scene.point_depths import HELD_OUT
from scene.readers.info import HOLD
from utils.system_utils import UserError, run_cli


def thinned(scene: Path, out: Path, keep: int) -> Path:
    """Write the scene `out`, with links to the photos."""
    names = []

    def chosen(views: list) -> list:
        tests, found = iter(views[::HOLD]), []
        for rank, view in enumerate(but_every(HOLD, views)[::keep]):
            found += ([] if rank % (HOLD - 1) else [next(tests)]) + [view]
        return [_renamed(view, rank) for rank, view in enumerate(found)]

    def _renamed(view: tuple[str, str], rank: int) -> tuple[str, str]:
        *pose, name = view[0].split(maxsplit=9)
        names.append((name, f"{rank:05d}{Path(name).suffix}"))
        return " ".join([*pose, names[-1][1]]), view[1]

    part(scene, out, chosen, lambda points: but_every(HELD_OUT, points))
    photos = out / "images"
    photos.unlink()
    photos.mkdir()
    for name, new in names:
        (photos / new).symlink_to((scene / "images" / name).resolve())
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help="a COLMAP scene")
    parser.add_argument("out", type=Path, help="new folder for the scene")
    parser.add_argument("--keep", type=int, default=3, help="every so many training photos stay (default: 3)")
    args = parser.parse_args()
    if args.out.exists():
        raise UserError(f"{args.out} exists; name a new folder")
    thinned(args.scene, args.out, args.keep)


if __name__ == "__main__":
    run_cli(main)
