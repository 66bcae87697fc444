"""Ray-traced scenes of which options are to make something: all have the demo's things.

    python -m benchmarks.scenes.made OUT sky balls

writes OUT/sky and OUT/balls. `clean` is the demo; `sky` stands before a sky without points; in `balls`, these roam
through 30 % of the training photos; `exposure` has exposures, white balance and vignetting of its training photos;
`wall` has a wall without texture; `fisheye` (of 200 degrees) and `panorama` are scored as they are. Test photos always
show the scene as it is.
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from applications.demo.make_scene import make_scene
from applications.demo.objects import Box, Sphere, Thing, backdrop_texture, demo_scene, marble
from scene.readers.info import HOLD
from utils.system_utils import UserError, run_cli

_VIEWS, _POINTS, _SIZE = 48, 8000, (240, 180)
_BALLS = 3  # in a photo
_STOPS, _BALANCE, _FALLOFF = 1.0, 0.15, 0.5  # largest exposure; deviation of a channel, stops; (tan of the corner)^2
_SKY = 1e4  # units away, where the cameras stand within four of each other


def add_balls(photo: int | None) -> list[Thing]:
    """The demo's things, and in 30 % of the photos balls somewhere among them; never in test photos."""
    things = demo_scene()
    if photo is not None and photo % HOLD and photo % 10 in (1, 4, 7):
        rng = np.random.default_rng(photo)
        for k in range(_BALLS):
            x, z, light, dark = *rng.uniform(-1.8, 1.8, 2), *rng.uniform(0, 1, (2, 3, 1)).astype(np.float32)
            things.append(Thing(Sphere((x, -rng.uniform(0.4, 1.2), z), 0.35), marble(light, dark, photo + k)))
    return things


def add_wall(_: int | None) -> list[Thing]:
    """The demo's things, and a wall of one colour behind them."""
    grey = np.full((3, 1), 0.7, np.float32)
    return [*demo_scene(), Thing(Box((0.1, -1.2, 2.0), (2.4, 1.2, 0.1), 0.0), lambda p: np.broadcast_to(grey, p.shape))]


def add_sky(photo: int | None) -> list[Thing]:
    """The demo's things before a sky so far away that it has no points."""
    things = demo_scene()[1:]
    if photo is None:
        return things
    nearer = np.float32(9 / _SKY)
    return [Thing(Sphere((0, 0, 0), _SKY, inside=True), lambda p: backdrop_texture(nearer * p), emissive=True), *things]


MADE = {
    "clean": {},
    "sky": {"things": add_sky},
    "balls": {"things": add_balls},
    "exposure": {},
    "wall": {"things": add_wall},
    "fisheye": {"camera": "fisheye"},
    "panorama": {"camera": "panorama"},
}


def write_made(name: str, out: Path) -> Path:
    """Write the scene of a name of MADE."""
    make_scene(out, _VIEWS, *((384, 192) if name == "panorama" else _SIZE), _POINTS, seed=0, **MADE[name])
    if name == "exposure":
        photos = sorted((out / "images").iterdir())
        expose_photos([path for k, path in enumerate(photos) if k % HOLD])
        split_cameras(out / "sparse" / "0", [path.name for path in photos[::HOLD]])
    return out


def split_cameras(model: Path, names: list[str]) -> None:
    """Give photos of a COLMAP model of one camera another one that is the same, as text."""
    import pycolmap  # after Pillow

    pycolmap.Reconstruction(str(model)).write_text(str(model))
    for path in model.glob("*.bin"):
        path.unlink()
    cameras, images = model / "cameras.txt", model / "images.txt"
    *head, camera = cameras.read_text().splitlines()
    cameras.write_text("\n".join([*head, camera, f"2{camera[1:]}", ""]))
    text = images.read_text()
    for name in names:
        text = text.replace(f" 1 {name}\n", f" 2 {name}\n")
    images.write_text(text)


def expose_photos(photos: list[Path]) -> None:
    """Take photos again, with exposures and balances whose mean over all is 0 stops, and the falloff of a lens.

    In linear light: pixels are those of sRGB (IEC 61966-2-1), and light beyond white is lost. The falloff is the fourth
    power of a cosine.
    """
    rng = np.random.default_rng(0)
    balance = rng.normal(scale=_BALANCE, size=(len(photos), 3))
    balance -= balance.mean(1, keepdims=True)
    stops = rng.permutation(np.linspace(-_STOPS, _STOPS, len(photos)))[:, None] + balance - balance.mean(0)
    for path, gain in zip(photos, 2**stops, strict=True):
        pixels = np.asarray(Image.open(path)) / 255
        rows, columns = (np.arange(side) + 0.5 - side / 2 for side in pixels.shape[:2])
        square = 4 * (rows[:, None] ** 2 + columns**2) / (pixels.shape[0] ** 2 + pixels.shape[1] ** 2)
        light = np.where(pixels > 0.04045, ((pixels + 0.055) / 1.055) ** 2.4, pixels / 12.92)
        light = np.minimum(light * gain / (1 + _FALLOFF * square[..., None]) ** 2, 1)
        pixels = np.where(light > 0.0031308, 1.055 * light ** (1 / 2.4) - 0.055, 12.92 * light)
        Image.fromarray(np.floor(255 * pixels + 0.5).astype(np.uint8)).save(path)


def main() -> None:
    """Make the scenes that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="folder for the scenes")
    parser.add_argument("names", nargs="+", choices=MADE, help="scenes to make")
    args = parser.parse_args()
    for name in args.names:
        if (args.out / name).exists():
            raise UserError(f"{args.out / name} exists; name another folder")
        write_made(name, args.out / name)


if __name__ == "__main__":
    run_cli(main)
