"""Trainings with changed constants of the code, each in a process of its own."""

import argparse
import contextlib
import functools
import importlib
import io
import multiprocessing
import os
import sys
import tempfile
from collections.abc import Generator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from groundwork.files.json_files import read_json
from splatting.records.error_curve import NAME, read_curve, whole_sets


class Training(NamedTuple):
    """Words for train.py, and what to change before it starts: "module:name" or "module:Class.name", and value."""

    words: tuple[str, ...]
    changes: Mapping[str, Any] = {}


def arguments(parser: argparse.ArgumentParser, seeds: Sequence[int]) -> tuple[argparse.Namespace, list[str]]:
    """Add scenes, --seeds and --gpus to a parser; what it then reads, and the words after -- for train.py."""
    parser.add_argument("scenes", nargs="+", help="scenes with test views")
    parser.add_argument("--seeds", type=int, nargs="+", default=seeds, help="default: %(default)s")
    parser.add_argument("--gpus", type=int, nargs="+", help="one training at a time for each number; default: one")
    words = sys.argv[1:]
    cut = words.index("--") if "--" in words else len(words)
    return parser.parse_args(words[:cut]), words[cut + 1 :]


def train_all(trainings: Sequence[Training], gpus: Sequence[int] | None) -> Generator[dict[str, Any], None, None]:
    """Train with --eval, and yield what `_train` returns for each, in their order.

    gpus: one training at a time for each number; None: one after another, on the CPU or the only GPU.
    """
    context = multiprocessing.get_context("spawn")
    slots = gpus or [None]
    with context.Manager() as manager:
        free = manager.Queue()
        for slot in slots:
            free.put(slot)
        with context.Pool(len(slots), maxtasksperchild=1) as pool:
            found = pool.imap(functools.partial(_train, gpus=free), trainings, chunksize=1)
            yield from tqdm(found, total=len(trainings), unit="training")
            pool.close()
            pool.join()


def _train(training: Training, gpus: Any) -> dict[str, Any]:
    """Train in this process; return the last record of train_log.json, with `test_psnr` (dB) and `ply_mb` (10^6 bytes).

    test_psnr: of all test views at the end.
    """
    from splatting.commands import train

    if (gpu := gpus.get()) is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = str(gpu)
    for name, value in training.changes.items():
        module, _, path = name.partition(":")
        *owners, attribute = path.split(".")
        setattr(functools.reduce(getattr, owners, importlib.import_module(module)), attribute, value)
    try:
        with tempfile.TemporaryDirectory() as out, contextlib.redirect_stderr(io.StringIO()):
            fixed = "--eval", "--quiet", "--disable_viewer", "--no_last_checkpoint"
            train.main(["-m", out, *fixed, *training.words])
            psnr = whole_sets(read_curve(Path(out) / NAME))[-1]["test_psnr"]
            saved = max(Path(out).glob("point_cloud/*/point_cloud.ply"), key=lambda file: file.stat().st_mtime_ns)
            last = read_json(Path(out) / "train_log.json")[-1]
            return last | {"test_psnr": psnr, "ply_mb": saved.stat().st_size / 1e6}
    finally:
        gpus.put(gpu)
