"""Score rendered test views against their ground truth: PSNR, SSIM, LPIPS, DISTS and ST-LPIPS.

python metrics.py -m MODEL [MODEL ...] [--lpips_net vgg|alex|both] [--weights FOLDER] [--stlpips]

Reads MODEL/test/<method>/{renders,gt}, masks if there are any, and the errors of depth that render.py --depth writes.
Writes MODEL/results.json (means), per_view.json, and metrics_info.json, which states the convention of each number.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass
from pathlib import Path

import groundwork.host.openmp  # noqa: F401  isort: skip  (before torch)
import numpy as np
import torch
from fused_ssim import fused_ssim

from arguments import OptionParser, read_cfg_args
from groundwork.files.image_files import pictures_at_once
from groundwork.files.json_files import read_json, write_json
from groundwork.host.progress import Bar, in_threads
from splatting.records import renders
from splatting.records.model_folder import json_or_none
from splatting.records.renders import DEPTHS, FITTED, INCOMPLETE, TIMES, image_of, image_size, mask_of, model_digest
from utils.lpips_utils import MIN_SIDE, NETS, LpipsUnavailable, load_dists, load_network, load_stlpips
from utils.system_utils import UserError, compute_device

CONVENTIONS = {
    "PSNR": "dB, from one mean squared error over pixels and channels of the 8-bit images; null where infinite, which "
    "no mean counts",
    "SSIM": "11x11 Gaussian window, sigma 1.5, zero padding, C1 0.01^2, C2 0.03^2, mean over pixels and channels",
    "LPIPS": "version 0.1, VGG-16, inputs in [0,1] without mapping, as in the published 3DGS tables",
    "LPIPS_vgg": "version 0.1, VGG-16, inputs mapped to [-1,1]",
    "LPIPS_alex": "version 0.1, AlexNet, inputs mapped to [-1,1]",
    "DISTS": "package DISTS-pytorch 0.1, VGG-16, inputs in [0,1] at their own size",
    "STLPIPS": "package stlpips-pytorch 0.0.2, shift-tolerant AlexNet, inputs mapped to [-1,1]",
    "PSNR_UNFITTED": "the PSNR of the same right halves in the views whose appearance is not fitted",
    "DEPTH": "relative error of the inverse depth at held-out points that the photo has seen: the median of a view",
    "DEPTH_95": "the same: what 95 % of a view's points are below",
}
BACKBONES = {"LPIPS": "vgg", "LPIPS_vgg": "vgg", "LPIPS_alex": "alex"}

MASKED = {
    "PSNR": "the mean over the pixels that count",
    "SSIM": "other pixels are 0 in both images, as beyond the border; 1 - SSIM is divided by the share that counts",
    "LPIPS": "other pixels of the render are the ground truth's; the mean of the map over the pixels that count",
    "DISTS": "other pixels of the render are the ground truth's",
}
MASKED["STLPIPS"] = MASKED["LPIPS"]
NETWORKS = ("LPIPS", "DISTS", "STLPIPS")  # what the names of their scores begin with
_SAME = 1e-9  # of SSIM, whose sum may differ in its last bits
Metric = Callable[[np.ndarray, np.ndarray, np.ndarray | None], float | None]
Scores = dict[str, dict[str, float | None]]


@dataclass(frozen=True)
class Pair:
    """The files of a render and its ground truth, with their common size in pixels.

    masked: true if a mask says which pixels count.
    """

    name: str
    render: Path
    truth: Path
    size: tuple[int, int]
    masked: bool


def find_pairs(model: Path) -> dict[str, list[Pair]]:
    """List the pairs of every method (sub-folder of `test`), both sorted by name. Only headers are read.

    UserError if anything prevents scoring.
    """
    if not model.is_dir():
        raise UserError(f"no such model folder: {model}; pass one that render.py has written into as -m")
    test = model / "test"
    methods = sorted(folder for folder in test.iterdir() if folder.is_dir()) if test.is_dir() else []
    if not methods:
        remedy = f"run render.py -m {model} first"
        if trained_with_eval(model) is False:
            remedy = "the model was trained without --eval and has no test views: train with --eval"
        elif not (model / "cfg_args").is_file():
            remedy = "pass a model folder that render.py has written into as -m"
        raise UserError(f"no rendered test views in {test}; {remedy}")
    return {folder.name: _list_pairs(folder) for folder in methods}


def _list_pairs(method: Path) -> list[Pair]:
    """List the pairs of one method, sorted by name. UserError for images that are missing, unequal or outdated."""
    names = {}
    if (method / INCOMPLETE).is_file():
        raise UserError(f"rendering of {method} was interrupted; run render.py again")
    times = json_or_none(method / TIMES)
    now = model_digest(method.parent.parent, method.name.removeprefix("ours_"))
    if isinstance(times, dict) and None not in (now, times.get("model_sha256")) and times["model_sha256"] != now:
        raise UserError(f"{method} shows an earlier model than the one saved now; run render.py again")
    for side in ("renders", "gt"):
        folder = method / side
        if not folder.is_dir():
            raise UserError(f"{folder} is missing; run render.py again")
        names[side] = {file.name for file in folder.iterdir() if not file.name.startswith(".")}
    if lonely := sorted(names["renders"] ^ names["gt"]):
        there, lacking = ("renders", "gt") if lonely[0] in names["renders"] else ("gt", "renders")
        raise UserError(f"{method}: {lonely[0]} is in {there} but not in {lacking}; run render.py again")
    if not names["gt"]:
        raise UserError(f"{method} has no images; run render.py again, unless the model has no test views")
    pairs = []
    for name in sorted(names["gt"]):
        render, truth = method / "renders" / name, method / "gt" / name
        mask = method / "masks" / name
        size = image_size(render)
        for file in (truth, mask):
            if file.exists() and (other := image_size(file)) != size:
                raise UserError(f"{render} has {size} pixels, but {file} {other}; run render.py again")
        pairs.append(Pair(name, render, truth, size, mask.is_file()))
    return pairs


def trained_with_eval(model: Path) -> bool | None:
    """Tell whether the model was trained with a held-out test set; None if cfg_args does not say."""
    if not (model / "cfg_args").is_file():
        return None
    stored = read_cfg_args(model).get("eval")
    return stored if isinstance(stored, bool) else None


def psnr(render: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float | None:
    """Return the PSNR in dB of two images (H, W, 3) uint8, exact up to the logarithm; None if they are equal.

    mask: (H, W) bool, the pixels that count. MASKED describes how each metric uses it.
    """
    if mask is not None:
        render, truth = render[mask], truth[mask]
    squares = int(((render.astype(np.int64) - truth.astype(np.int64)) ** 2).sum())
    return 10 * math.log10(255**2 * render.size / squares) if squares else None


def ssim(render: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the mean SSIM of two images (H, W, 3) uint8, computed in float64."""
    if mask is not None:
        render, truth = render * mask[..., None], truth * mask[..., None]
    channels_first = [torch.from_numpy(image.transpose(2, 0, 1) / 255.0) for image in (render, truth)]
    similarity = float(fused_ssim(*channels_first, train=False))
    return similarity if mask is None else 1 - (1 - similarity) * mask.size / int(mask.sum())


def _lpips_metric(network: torch.nn.Module, unit_range: bool, device: torch.device) -> Metric:
    """Return LPIPS by a network of `load_network` or `load_stlpips`, whose normalisation expects [-1, 1].

    unit_range: True passes [0, 1] nevertheless, as for the published 3DGS numbers; False maps to [-1, 1] first, as the
    package documents.
    """

    @torch.no_grad()
    def metric(render: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
        network.spatial = mask is not None  # without a mask the layers' means are added, as published
        distance = network(*_to_tensors(render, truth, mask, device), normalize=not unit_range)
        return float(distance if mask is None else distance[0, 0][torch.from_numpy(mask).to(device)].mean())

    return metric


def _dists_metric(network: torch.nn.Module, device: torch.device) -> Metric:
    """Return DISTS by the network of `load_dists`."""
    return lambda render, truth, mask: float(network(*_to_tensors(render, truth, mask, device)))


def _to_tensors(
    render: np.ndarray, truth: np.ndarray, mask: np.ndarray | None, device: torch.device
) -> list[torch.Tensor]:
    """Return both images (1, 3, H, W) in [0, 1]; pixels of the render that do not count are the ground truth's."""
    both = (render if mask is None else np.where(mask[..., None], render, truth), truth)
    return [torch.from_numpy(image.transpose(2, 0, 1)[None].copy()).to(device) / 255 for image in both]


def make_metrics(lpips_net: str, weights: Path | None, smallest_side: int, stlpips: bool = False) -> dict[str, Metric]:
    """Make the metrics by key, in the order of the files.

    weights: folder of the networks' weights, where a missing or wrong one is a UserError. smallest_side: smallest side
    of all images, in pixels. If a backbone or its weights are missing, a line says so and its metrics return None.
    stlpips: with ST-LPIPS, a UserError without its package.
    """
    keys = ["SSIM", "PSNR", "LPIPS"] + [f"LPIPS_{net}" for net in ("vgg", "alex") if lpips_net in (net, "both")]
    metrics: dict[str, Metric] = dict.fromkeys(keys, lambda render, truth, mask: None)
    metrics.update(SSIM=ssim, PSNR=psnr)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if stlpips:
        if smallest_side < MIN_SIDE["stlpips"]:
            least = MIN_SIDE["stlpips"]
            raise UserError(f"ST-LPIPS needs images with sides of at least {least} pixels; leave --stlpips out")
        metrics["STLPIPS"] = _lpips_metric(load_stlpips(device), False, device)
    for net in ("vgg", "alex"):
        if lpips_net not in (net, "both"):
            continue
        mine = [key for key in keys if BACKBONES.get(key) == net]
        try:
            if smallest_side < MIN_SIDE[net]:
                raise LpipsUnavailable(f"{NETS[net]} needs images with sides of at least {MIN_SIDE[net]} pixels")
            network = load_network(net, weights, device)
            metrics.update({key: _lpips_metric(network, key == "LPIPS", device) for key in mine})
        except LpipsUnavailable as reason:
            print(f"cannot compute {', '.join(mine)} (null unless scored before): {reason}")
    if weights:
        try:
            metrics["DISTS"] = _dists_metric(load_dists(weights, device), device)
        except LpipsUnavailable as reason:
            print(f"DISTS is left out: {reason}")
    return metrics


def score(pairs: list[Pair], metrics: dict[str, Metric], title: str, errors: bool = False) -> Scores:
    """Compute every metric of every pair, {metric: {file name: value}}, with few pairs in memory at a time.

    A pair without pixels that count is left out. errors: write an error map of each, too.
    """
    scores: Scores = {key: {} for key in metrics}
    size = pictures_at_once(max((math.prod(pair.size) for pair in pairs), default=0))  # read at once, by all cores
    with Bar(total=len(pairs), desc=title, unit="view") as bar:
        for first in range(0, len(pairs), size):
            batch = pairs[first : first + size]
            for pair, (render, truth, mask) in zip(batch, in_threads(_read_pair, batch, disable=True), strict=True):
                if mask is None or mask.any():
                    for key, metric in metrics.items():
                        scores[key][pair.name] = metric(render, truth, mask)
                    if errors:
                        renders.write_error_map(pair.truth.parents[1], pair.name, truth, render, mask)
                bar.update()
    return scores


def _read_pair(pair: Pair) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return render and ground truth (H, W, 3) uint8, and the mask (H, W) bool of the pixels that count, None: all."""
    render, truth = (np.asarray(image_of(file)) for file in (pair.render, pair.truth))
    return render, truth, mask_of(pair.truth.parents[1], pair.name)


def _score_unfitted(whole: list[Pair], fitted: list[Pair], scored: Container[str]) -> dict[str, float | None]:
    """Return the PSNR of the right halves of views, without the appearance that was fitted to the left halves.

    Returns it by file name, for comparison with the scores of the fitted halves.

    whole: pairs of whole pictures, as the model renders them.
    fitted: pairs of the same views, of which only the right halves are shown, with fitted appearance.
    scored: file names of the views that are scored.
    """
    found, widths = {}, {pair.name: pair.size[0] for pair in fitted if pair.name in scored}
    for pair in (pair for pair in whole if pair.name in widths):
        mask = mask_of(pair.truth.parents[1], pair.name)
        images = (np.asarray(image_of(file)) for file in (pair.render, pair.truth))
        parts = (None if image is None else image[:, -widths[pair.name] :] for image in (*images, mask))
        found[pair.name] = psnr(*parts)
    return found


def mean(values: dict[str, float | None]) -> float | None:
    """Return the mean over the views that have a number; None if none has one.

    Either all views have a number or none has, except for infinite PSNRs.
    """
    numbers = [value for value in values.values() if value is not None]
    return math.fsum(numbers) / len(numbers) if numbers else None


def readImages(renders_dir: str | Path, gt_dir: str | Path) -> tuple[list[torch.Tensor], list[torch.Tensor], list[str]]:
    """Read the images of two folders of equal names, sorted: renders, ground truth, names.

    Images are (1, 3, H, W) float32 in [0, 1] on the device that computes. UserError for a damaged image.
    """
    names = sorted(file.name for file in Path(renders_dir).iterdir() if not file.name.startswith("."))

    def read(folder: str | Path) -> list[torch.Tensor]:
        pixels = [torch.from_numpy(np.array(image_of(Path(folder) / name))) for name in names]
        return [image.to(compute_device()).permute(2, 0, 1)[None].contiguous() / 255 for image in pixels]

    return read(renders_dir), read(gt_dir), names


def evaluate(
    model_paths: Sequence[str | Path],
    lpips_net: str = "vgg",
    weights: str | Path | None = None,
    error_maps: bool = False,
    stlpips: bool = False,
) -> None:
    """Score model folders, print the means and write the files of scores, as the command does.

    lpips_net: "vgg", "alex" or "both". weights: folder of torchvision's files of vgg16 and alexnet, instead of torch's
    cache and a download. error_maps: write `test/METHOD/errors`, too. stlpips: score ST-LPIPS, too. UserError if a
    folder cannot be scored, after the others were.
    """
    found, failed = {}, []
    for model in map(Path, model_paths):
        try:
            found[model] = find_pairs(model)
        except UserError as error:
            failed.append(str(error))
    if not found:
        raise UserError("; ".join(failed))
    sides = [side for methods in found.values() for pairs in methods.values() for pair in pairs for side in pair.size]
    metrics = make_metrics(lpips_net, weights and Path(weights), min(sides), stlpips)
    for model, methods in found.items():
        _score_model(model, methods, metrics, error_maps)
    if failed:
        raise UserError("; ".join(failed))


def depth_scores(method: Path) -> Scores:
    """Return the errors of depth that render.py has written beside the renders of a method; none without a file."""
    found = json_or_none(method / DEPTHS) or {}
    keys = dict.fromkeys(key for of_view in found.values() for key in of_view)
    return {key.upper(): {name: of_view[key] for name, of_view in found.items() if key in of_view} for key in keys}


def keep_networks(model: Path, method: str, scores: Scores) -> list[str]:
    """Add scores of NETWORKS in model/per_view.json to new scores of a method that lack them; return their names.

    None are added unless every view has the same PSNR and SSIM as then, which other pictures would change.
    """
    views = scores["PSNR"].keys()
    try:
        earlier = read_json(model / "per_view.json")[method]
        pairs = [(scores[name][view], earlier[name][view]) for name in ("PSNR", "SSIM") for view in views]
        if earlier["PSNR"].keys() != views or not all(new == old or abs(new - old) < _SAME for new, old in pairs):
            return []
        kept = [
            name
            for name, values in earlier.items()
            if name.startswith(NETWORKS)
            and set(scores.get(name, {}).values()) <= {None}
            and values.keys() == views
            and all(type(value) is float and math.isfinite(value) for value in values.values())
        ]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return []  # there is none, or nobody can use it
    scores |= {name: {view: earlier[name][view] for view in views} for name in kept}
    return kept


def _score_model(model: Path, methods: dict[str, list[Pair]], metrics: dict[str, Metric], error_maps: bool) -> None:
    """Score all methods of a model folder, print means and worst views, and write the three files of scores."""
    held_out = trained_with_eval(model)
    if held_out is False:
        print(f"warning: {model} was trained without --eval, so these scores are of training views")
    per_view = {name: score(pairs, metrics, f"{model.name}/{name}", error_maps) for name, pairs in methods.items()}
    for name, scores in per_view.items():
        if kept := keep_networks(model, name, scores):
            print(f"{model} {name}: kept {', '.join(kept)} of an earlier scoring of the same pictures")
        scores |= depth_scores(model / "test" / name)
        if (plain := methods.get(name.removesuffix(f"_{FITTED}"), methods[name])) is not methods[name]:
            scores |= {"PSNR_UNFITTED": _score_unfitted(plain, methods[name], scores["PSNR"])}
    results = {name: {key: mean(values) for key, values in scores.items()} for name, scores in per_view.items()}
    for name, means in results.items():
        shown = "  ".join(f"{key} {'null' if value is None else f'{value:.4f}'}" for key, value in means.items())
        print(f"{model} {name} ({len(methods[name])} views): {shown}")
        if equal := sum(value is None for value in per_view[name]["PSNR"].values()):
            print(f"{equal} renders equal their photos; their PSNR is infinite, and the mean leaves them out")
        if worst := renders.worst_views(model, per_view[name]["PSNR"]):
            print("worst views:", ", ".join(f"{it['picture']} {it['PSNR']:.2f} dB" for it in worst))
    info = {
        "conventions": {key: CONVENTIONS[key] for scores in per_view.values() for key in scores},
        "trained_with_eval": held_out,
        "views": {name: len(pairs) for name, pairs in methods.items()},
        "sizes": {name: sorted({pair.size for pair in pairs}) for name, pairs in methods.items()},
    }
    masked = {name: sum(pair.masked for pair in pairs) for name, pairs in methods.items()}
    if any(masked.values()):
        info |= {"masked": {key: MASKED[key.split("_")[0]] for key in metrics}, "masked_views": masked}
    write_json(model / "results.json", results, sort_keys=False)
    write_json(model / "per_view.json", per_view, sort_keys=False)
    write_json(model / "metrics_info.json", info)


def main() -> None:
    """Score the model folders that the command line names."""
    parser = OptionParser(description="Score rendered test views: PSNR, SSIM, LPIPS, DISTS, ST-LPIPS.")
    add = parser.add_argument
    add("-m", "--model_paths", type=Path, nargs="+", required=True,
        help="model folders to score (default: none, must be given)")  # fmt: skip
    add("--lpips_net", choices=("vgg", "alex", "both"), default="vgg",
        help="LPIPS backbone: vgg for LPIPS (as in published tables) and LPIPS_vgg, alex for LPIPS_alex (default: "
        "vgg)")  # fmt: skip
    add("--weights", type=Path, metavar="FOLDER",
        help="folder of torchvision's files vgg16-397923af.pth, for LPIPS and DISTS, and alexnet-owt-7be5be79.pth; "
        "nothing is downloaded then (default: torch's cache, or else a download into it, and no DISTS)")  # fmt: skip
    add("--stlpips", action="store_true",
        help="also score ST-LPIPS, whose weights come with the package stlpips-pytorch (`pip install '.[stlpips]'`; in "
        "part not for commercial use) (default: off)")  # fmt: skip
    add("--error_maps", action="store_true",
        help="also write error maps into test/METHOD/errors (default: off)")  # fmt: skip
    args = parser.parse_args()
    evaluate(args.model_paths, args.lpips_net, args.weights, args.error_maps, args.stlpips)
