"""LPIPS of an earlier scoring, kept where it cannot be computed again and the pictures are the same."""

import math
from pathlib import Path

from splatting.files.json_files import read_json

_SAME = 1e-9  # of SSIM, whose sum may differ in its last bits


def keep_lpips(model: Path, method: str, scores: dict[str, dict[str, float | None]]) -> list[str]:
    """Add the LPIPS that model/per_view.json has of a method to new scores, {metric: {file name: value}}, that lack it.

    Return the metrics that were added. None are unless every view has the same PSNR and SSIM as then, which other
    pictures would change.
    """
    try:
        earlier = read_json(model / "per_view.json")[method]
        if not all(_same(scores[name], earlier[name]) for name in ("PSNR", "SSIM")):
            return []
        kept = [
            name
            for name, values in earlier.items()
            if name.startswith("LPIPS")
            and set(scores.get(name, {}).values()) <= {None}
            and values.keys() == scores["PSNR"].keys()
            and all(type(value) is float and math.isfinite(value) for value in values.values())
        ]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return []  # there is none, or nobody can use it
    for name in kept:
        scores[name] = {view: earlier[name][view] for view in scores["PSNR"]}
    return kept


def _same(new: dict[str, float | None], old: dict[str, float | None]) -> bool:
    return new.keys() == old.keys() and all(
        new[view] == old[view] or (None not in (new[view], old[view]) and abs(new[view] - old[view]) < _SAME)
        for view in new
    )
