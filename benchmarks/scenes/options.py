"""Trainings with options of train.py and without, over scenes and seeds: scores, errors of depth, seconds, Gaussians.

    python -m benchmarks.scenes.options OUT --scenes SCENE ... --keep 3 --with="--sparse_depth 0.1" --iterations 1000
    python -m benchmarks.scenes.options OUT --made wall fisheye --with="--lenses undistort" --iterations 1000
    python -m benchmarks.scenes.options OUT --scenes SCENE --with=--filter_3d --widths 34 67 269 538 -r 4

--keep N trains on every N-th training photo alone, without the points that judge the depth, and scores all test photos.
--widths W ... scores test views of these widths (px) besides, such as a quarter, half and double of the training's.
--made ray-traces scenes: the demo's; before a sky without points; with balls that roam through 30 % of its training
photos; with exposures, white balance and vignetting of its training photos; with a wall without texture in it; and of
fisheyes of 200 degrees and panoramas, which are scored as they are. Test photos always show the scene as it is. Their
depth is known, so floaters are counted, too. `fitted` is the PSNR of right halves of test photos, with exposure and
balance fitted to the left ones. Other options go to train.py.
"""

import argparse
import shlex
from pathlib import Path
from statistics import mean, stdev

import numpy as np
from PIL import Image

from benchmarks.harness.colmap_part import but_every, part
from benchmarks.harness.measuring import describe, print_table
from benchmarks.scenes.training import train
from scene.dataset_readers import read_scene
from scene.readers.info import HOLD
from splatting.demo.make_scene import make_scene
from splatting.demo.objects import Box, Sphere, Thing, backdrop_texture, demo_scene, marble
from splatting.demo.tracer import CAMERAS, ring_views, trace
from splatting.evaluation.comparison import BESIDE
from splatting.files.image_files import read_plane
from splatting.training.sparse_depth import HELD_OUT
from utils.system_utils import UserError, compute_device, run_cli

_VIEWS, _POINTS, _SIZE = 48, 8000, (240, 180)
_BALLS = 3  # in a photo
_STOPS, _BALANCE, _FALLOFF = 1.0, 0.15, 0.5  # largest exposure; deviation of a channel, stops; (tan of the corner)^2
_SKY = 1e4  # units away, where the cameras stand within four of each other
_BEYOND = 4  # extents, farther than all things but the sky
FORMS = {"PSNR": ".2f", "fitted": ".2f", "SSIM": ".4f", "DEPTH": ".2%", "DEPTH_95": ".1%", "NEAR": ".2%", "SKY": ".1%"}
FORMS |= {"seconds": ".1f", "Gaussians": ",.0f"}


def with_balls(photo: int | None) -> list[Thing]:
    """The demo's things, and in 30 % of the photos balls somewhere among them; never in test photos."""
    things = demo_scene()
    if photo is not None and photo % HOLD and photo % 10 in (1, 4, 7):
        rng = np.random.default_rng(photo)
        for k in range(_BALLS):
            x, z, light, dark = *rng.uniform(-1.8, 1.8, 2), *rng.uniform(0, 1, (2, 3, 1)).astype(np.float32)
            things.append(Thing(Sphere((x, -rng.uniform(0.4, 1.2), z), 0.35), marble(light, dark, photo + k)))
    return things


def with_wall(_: int | None) -> list[Thing]:
    """The demo's things, and a wall of one colour behind them."""
    grey = np.full((3, 1), 0.7, np.float32)
    return [*demo_scene(), Thing(Box((0.1, -1.2, 2.0), (2.4, 1.2, 0.1), 0.0), lambda p: np.broadcast_to(grey, p.shape))]


def with_sky(photo: int | None) -> list[Thing]:
    """The demo's things before a sky so far away that it has no points."""
    things = demo_scene()[1:]
    if photo is None:
        return things
    nearer = np.float32(9 / _SKY)
    return [Thing(Sphere((0, 0, 0), _SKY, inside=True), lambda p: backdrop_texture(nearer * p), emissive=True), *things]


MADE = {
    "clean": {},
    "sky": {"things": with_sky},
    "balls": {"things": with_balls},
    "exposure": {},
    "wall": {"things": with_wall},
    "fisheye": {"camera": "fisheye"},
    "panorama": {"camera": "panorama"},
}


def made(name: str, out: Path) -> Path:
    """Write the scene of a name of MADE."""
    make_scene(out, _VIEWS, *_size(name), _POINTS, seed=0, **MADE[name])
    if name == "exposure":
        photos = sorted((out / "images").iterdir())
        expose([path for k, path in enumerate(photos) if k % HOLD])
        by_another_camera(out / "sparse" / "0", [path.name for path in photos[::HOLD]])
    return out


def by_another_camera(model: Path, names: list[str]) -> None:
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


def expose(photos: list[Path]) -> None:
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


def _size(name: str) -> tuple[int, int]:
    return (384, 192) if name == "panorama" else _SIZE


def floaters(name: str, scene: Path, model: Path) -> dict[str, float]:
    """What stands in front of a made scene in depth maps of its test views, 1 / (inverse depth / alpha) of render.py.

    `NEAR`: the part of the pixels nearer than a quarter of the extent where the traced depth is not. `SKY`: the part of
    the sky's pixels nearer than _BEYOND extents; none without a sky.
    """
    how, extent = MADE[name], read_scene(scene, "images", hold_out=True, native=True).extent
    views = ring_views(_VIEWS, *_size(name), np.random.default_rng(0), CAMERAS[how.get("camera", "pinhole")])
    things, found = how.get("things", lambda _: demo_scene())(None), []
    (folder,) = (path for path in (model / "test").iterdir() if not path.name.endswith(BESIDE))
    for place, view in enumerate(views[::HOLD]):
        inverse, alpha = (read_plane(folder / plane / f"{place:05d}.png") for plane in ("depth", "alpha"))
        y, x = (np.indices(inverse.shape) + 0.5).reshape(2, -1)
        directions = view.rays(x * view.width / inverse.shape[1], y * view.height / inverse.shape[0])
        truth, _ = trace(things, view.center.astype(np.float32).reshape(3, 1), directions)
        if view.model == "PINHOLE":
            truth = truth * (view.rotation[2] @ directions)
        found.append(np.stack([truth, inverse.ravel() * extent, alpha.ravel()]))
    truth, inverse, alpha = np.concatenate(found, axis=1)
    sky = np.isinf(truth)
    near = float(((inverse > 4 * alpha) & (truth > extent / 4)).mean())
    return {"NEAR": near} | ({"SKY": float((inverse * _BEYOND > alpha)[sky].mean())} if sky.any() else {})


def thinned(scene: Path, out: Path, keep: int) -> Path:
    """Write a COLMAP scene of every `keep`-th training photo of another, without the points that judge the depth."""
    return part(scene, out, lambda views: but_every(HOLD, views)[::keep], lambda points: but_every(HELD_OUT, points))


def compare(
    scene: Path,
    out: Path,
    sets: list[str],
    args: argparse.Namespace,
    options: list[str],
    forms: dict[str, str],
    name: str,
) -> list[list[str]]:
    """Train with each set of options, the first of which the others are compared with; a row for each.

    name: of MADE, for scenes of which the depth is known everywhere; empty for others.
    """
    given, keep, whole = {"widths": args.widths}, args.keep, scene
    shown = ["--depth", "--lenses", "native", *(["--alpha"] if name else [])]
    if keep > 1:
        given, scene = given | {"judged": scene}, thinned(scene, out / "thinned", keep)
    rows, first = [], []
    for number, words in enumerate(sets):
        runs, own = [], [*options, *shlex.split(words)]
        fits = [] if {"affine", "--train_test_exp"} & set(own) else ["--appearance", "ppisp"]
        for seed in args.seeds:
            model = out / f"{number}_{seed}"
            runs.append(train(scene, model, seed, own, shown=[*shown, *fits], **given))
            runs[-1] |= floaters(name, whole, model) if name else {}
            print(out.name, words, seed, {name: runs[-1].get(name) for name in forms}, flush=True)
        values = {name: [run[name] for run in runs if run.get(name) is not None] for name in forms}
        first = first or values["PSNR"]
        gains = [psnr - other for psnr, other in zip(values["PSNR"], first, strict=True)]
        spread = f" ({stdev(gains):.2f})" if len(gains) > 1 else ""
        cells = [f"{mean(of):{form}}" if (of := values[name]) else "" for name, form in forms.items()]
        rows.append([words or "none", *cells, f"{mean(gains):+.2f}{spread}" if number else ""])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0], allow_abbrev=False)
    add = parser.add_argument
    add("out", type=Path, help="new folder for the scenes and the models")
    add("--scenes", type=Path, nargs="+", default=[], help="COLMAP scenes")
    add("--made", nargs="+", choices=MADE, default=[], help="scenes to make")
    add("--with", action="append", dest="sets", default=[], help="options to compare with none; may be repeated")
    add("--keep", type=int, default=1, help="train on every so many training photos (default: 1, all)")
    add("--widths", type=int, nargs="+", default=[], help="widths of test views to score besides (px)")
    add("--seeds", type=int, nargs="+", default=[0, 1, 2], help="one run each (default: 0 1 2)")
    args, options = parser.parse_known_args()
    if args.out.exists():
        raise UserError(f"{args.out} exists; name a new folder")
    print(describe(compute_device()), "\ntrain.py --eval", *options, flush=True)
    out, rows = args.out.resolve(), []
    wide = {f"{name}@{width}": FORMS[name] for width in args.widths for name in ("PSNR", "SSIM")}
    scenes = [(path.resolve(), "") for path in args.scenes]
    for scene, name in [*scenes, *((made(name, out / "scenes" / name), name) for name in args.made)]:
        found = compare(scene, out / scene.name, ["", *args.sets], args, options, FORMS | wide, name)
        rows += [[scene.name, *row] for row in found]
    scores = ["PSNR dB", "fitted dB", "SSIM", "depth error", "95 %", "near", "before sky"]
    print_table(["scene", "options", *scores, "training s", "Gaussians", *wide, "gain dB"], rows)


if __name__ == "__main__":
    run_cli(main)
