"""Scores of models that full_eval.py has trained, rendered with other options of render.py: depth, floaters, sizes.

    python -m benchmarks.scenes.scores OUT -- --depth --alpha --lenses native --appearance ppisp
    python -m benchmarks.scenes.scores OUT -- -r 34      # views 34 pixels wide

OUT is an output folder of full_eval.py. A row for each scene and option set has means over the seeds; `gain` is that of
the PSNR over the first set, with its standard deviation. `fitted` is the PSNR of right halves of test photos, with
exposure and balance fitted to the left ones (--appearance ppisp). Floaters are counted in scenes of
benchmarks.scenes.made, whose depth is known (--depth --alpha). The next call of full_eval.py renders as before.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from statistics import mean, stdev

import numpy as np

from benchmarks.harness.measuring import print_table
from benchmarks.scenes.made import MADE, VIEWS, size
from scene.dataset_readers import read_scene
from scene.readers.info import HOLD
from splatting.demo.objects import demo_scene
from splatting.demo.tracer import CAMERAS, ring_views, trace
from splatting.evaluation import stages
from splatting.evaluation.child import run_child
from splatting.evaluation.comparison import BESIDE, FITTED, grouped
from splatting.evaluation.plan import Run
from splatting.evaluation.renders import TIMES
from splatting.evaluation.results import read_earlier
from splatting.files.image_files import read_plane
from splatting.files.json_files import read_json
from utils.system_utils import UserError, run_cli

_BEYOND = 4  # extents, farther than all things but the sky
FORMS = {"PSNR": ".2f", "fitted": ".2f", "SSIM": ".4f", "DEPTH": ".2%", "DEPTH_95": ".1%", "NEAR": ".2%", "SKY": ".1%"}


def scores(run: Run, options: Sequence[str]) -> dict[str, float | None]:
    """Render and score the last iteration of a model, with options of render.py."""
    stages.render(run, options, run_child)
    (run.model / "results.json").unlink(missing_ok=True)  # those of another scene (-s) are to be scored, too
    stages.score(run, run_child, download=False)
    times = [path for path in run.model.glob(f"test/*/{TIMES}") if not path.parent.name.endswith(BESIDE)]
    folder = max(times, key=lambda path: path.stat().st_mtime_ns).parent
    found, traced = read_json(run.model / "results.json"), run.scene.name in MADE
    fitted = found.get(f"{folder.name}_{FITTED}", {}).get("PSNR")
    seen = floaters(run.scene.name, run.scene.source, folder) if traced and (folder / "alpha").is_dir() else {}
    return found[folder.name] | {"fitted": fitted} | seen


def floaters(name: str, scene: Path, folder: Path) -> dict[str, float]:
    """What stands in front of a made scene in depth maps of its test views, 1 / (inverse depth / alpha) of render.py.

    `NEAR`: the part of the pixels nearer than a quarter of the extent where the traced depth is not. `SKY`: the part of
    the sky's pixels nearer than _BEYOND extents; none without a sky.
    """
    how, extent = MADE[name], read_scene(scene, "images", hold_out=True, native=True).extent
    views = ring_views(VIEWS, *size(name), np.random.default_rng(0), CAMERAS[how.get("camera", "pinhole")])
    things, found = how.get("things", lambda _: demo_scene())(None), []
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="output folder of full_eval.py")
    parser.add_argument("options", nargs="*", help="of render.py, after --")
    args = parser.parse_args()
    runs = [run for run, _ in read_earlier(args.out.resolve())["runs"].values()]
    if not runs:
        raise UserError(f"{args.out} has no report of full_eval.py; name its --output_path")
    named = [{"scene": run.scene.name, "config": run.config or "-", "run": run} for run in runs]
    rows, first = [], {}
    for (scene, config), seeds in grouped(named, "scene", "config").items():
        found = [scores(one["run"], args.options) for one in seeds]
        values = {name: [one[name] for one in found if one.get(name) is not None] for name in FORMS}
        least = first.setdefault(scene, values["PSNR"])
        gains = [psnr - other for psnr, other in zip(values["PSNR"], least, strict=True)]
        spread = f" ({stdev(gains):.2f})" if len(gains) > 1 else ""
        cells = [f"{mean(of):{form}}" if (of := values[name]) else "" for name, form in FORMS.items()]
        rows.append([scene, config, *cells, f"{mean(gains):+.2f}{spread}"])
    heads = ["PSNR dB", "fitted dB", "SSIM", "depth error", "95 %", "near", "before sky"]
    print_table(["scene", "options", *heads, "gain dB"], rows)


if __name__ == "__main__":
    run_cli(main)
