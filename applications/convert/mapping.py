"""Mapping in several ways, until a model agrees with the pairs of photos that it was made from (scene/agreement.py).

Each way fails on some captures, without saying so. The best model is kept, without photos that contradict the others.
A pair is two photos whose matches passed a geometric check of the pair alone.
"""

import shutil
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from applications.convert.checks import is_folded, is_only_turned, is_wrong
from applications.convert.colmap import (
    ADDING,
    ALL_PAIRS,
    GIVEN,
    Backend,
    Command,
    copy_database,
    count_rows,
    list_photos,
    worker_command,
)
from groundwork.files.json_files import read_json, write_json
from utils.system_utils import UserError

AGREEING = 0.9  # share of the photos that pairs bind, which agree in a model that is kept at once
_FEW = 20  # photos, which incremental mapping takes two seconds for
_FOLDED = 2  # ways that fold a scene, after which no other is tried
_NAMES = {
    "direct": "direct global mapping",
    "grown": "incremental mapping from the photos that agree",
    "free": "incremental mapping without given focal lengths",
}


def map_photos(backend: Backend, run: Callable[..., None], place: Callable[[str, Any], None]) -> None:
    """Fill `layout.models` with the models of the best way, and `layout.judged`.

    run: runs commands. place: runs those of a way under a title.
    """
    layout = backend.layout
    if backend.settings.mapper == GIVEN:
        place("Mapping", backend.mapping(GIVEN, layout.models))
        return
    copy_database(layout.database, layout.calibrated)
    try:
        run(backend.calibration(), "Calibrating")
    except UserError as error:  # some ways do without
        print(f"warning: focal lengths could not be estimated: {error}", file=sys.stderr)
    tried: list[dict[str, Any]] = []
    ways = _order_ways(backend.ways, count_rows(layout.database, "images"))
    while ways:
        way = ways.pop(0)
        title = "Mapping" if not tried else f"Mapping, try {len(tried) + 1}"
        tried.append(_try_way(backend, way, partial(place, title), run, *tried[-1:]))
        if is_accepted(tried[-1]) or is_only_turned(tried[-1]) or sum(map(is_folded, tried)) == _FOLDED:
            break
        if ways[:1] == ["grown"] and not tried[-1].get("against"):
            ways.pop(0)
        if ways:
            print(f"{_describe_try(tried[-1])}; trying {way_name(ways[0])}")
    tried = sorted(tried, key=partial(_rank_model, tried), reverse=True)
    best = tried[0]
    if "failed" in best:
        if not any((layout.tried / best["way"]).glob("*/*")):
            raise UserError(best["failed"])
        print(f"warning: the poses could not be judged: {best['failed']}", file=sys.stderr)
    (layout.tried / best["way"]).rename(layout.models)
    shutil.rmtree(layout.tried, ignore_errors=True)
    if not is_folded(best):
        best["against"] = sorted({*best.get("against", ()), *best.get("alike", ())})
    if best.get("against") and backend.settings.mapper == ADDING:
        old = set(list_photos(layout.base_database))
        best["against"] = [name for name in best["against"] if name not in old]
    if best.get("against") and not is_folded(best):
        model = str(layout.models / best["folder"])
        run([worker_command(layout, "keep", model=model, left_out=best["against"])], "Leaving out photos")
        left = {**best["left"], "photos": best["photos"] - len(best["against"]), "alike": [], "alike_pair": None}
        best |= {**left, "against": best["against"]}
    write_json(layout.judged, [{name: value for name, value in one.items() if name != "left"} for one in tried])


def _order_ways(ways: Sequence[str], count: int) -> list[str]:
    """Order the ways of mapping for `count` photos: where they are few, the incremental one succeeds more often."""
    first = {"incremental"} if count <= _FEW else {"direct", "grown", "incremental"} if count <= ALL_PAIRS else ()
    return sorted(ways, key=lambda way: way not in first)


def is_accepted(found: Mapping[str, Any]) -> bool:
    """Tell if a judged model is good enough to be kept without another try."""
    return found.get("agreeing", 0) >= AGREEING * found.get("bound", 0) > 0 and not is_wrong(found)


def _try_way(
    backend: Backend,
    way: str,
    place: Callable[[list[Command]], None],
    run: Callable[..., None],
    before: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Map in one way, and return the judgement of the models, or a message `failed` instead.

    before: judgement of the way before, from whose sound part `grown` begins.
    """
    start, models = time.monotonic(), backend.layout.tried / way
    job = {}
    if way == "grown" and before:
        job = {"base": str(backend.layout.tried / before["way"] / before["folder"]), "left_out": before["against"]}
    try:
        place(backend.mapping(way, models, **job))
        found = _judge_models(backend, models, run)
    except UserError as error:
        found = {"failed": str(error)}
    return {"way": way, "seconds": round(time.monotonic() - start, 1)} | found


def _judge_models(backend: Backend, models: Path, run: Callable[..., None]) -> dict[str, Any]:
    out = backend.layout.work / "judging.json"
    places = {"models": str(models), "calibrated": str(backend.layout.calibrated), "out": str(out)}
    run([worker_command(backend.layout, "judging", **places)], "Judging")
    return read_json(out)


def _rank_model(tried: Sequence[Mapping[str, Any]], found: Mapping[str, Any]) -> tuple[bool, bool, int, int]:
    """Return a sort key of how good a model is among those that were tried.

    A model that is far smaller than another may be right by chance. A model that lacks photos of a folded one may be
    folded, too, where only these photos would show it.
    """
    photos, most = found.get("photos", 0), max(one.get("photos", 0) for one in tried)
    folded = max((one["photos"] for one in tried if is_folded(one)), default=0)
    is_sound = not is_wrong(found) and 2 * photos >= most and photos >= AGREEING * folded
    return photos > 0, is_sound, found.get("agreeing", 0), photos


def way_name(way: str) -> str:
    return _NAMES.get(way, f"{way} mapping")


def _describe_try(found: Mapping[str, Any]) -> str:
    """Return, in a few words, why the model of one way of mapping was not accepted. found: its judgement."""
    if "failed" in found:
        return f"{way_name(found['way'])} failed"
    if not found.get("photos"):
        return f"{way_name(found['way'])} placed no photo"
    if is_folded(found):
        return f"{way_name(found['way'])} laid photos of different things upon each other"
    agree = f"{found['agreeing']} of {found['bound']} photos"
    return f"{way_name(found['way'])}: the matches of {agree} agree with their poses"
