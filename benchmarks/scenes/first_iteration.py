"""Run train.py and note when its first iteration ended and how much memory the process needed.

    python -m benchmarks.scenes.first_iteration STARTED FILE [--not_ahead] [options of train.py]

large_set.py runs this command in a process of its own. FILE gets, as JSON, seconds from STARTED (Unix time) to the end
of iteration 1, and the peaks of host and GPU memory in bytes.
"""

import argparse
import resource
import time
from pathlib import Path

import torch

import train
from scene.gaussian_model import GaussianModel
from scene.pictures.store import ImageStore
from utils.files.json_files import write_json


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0], allow_abbrev=False)
    parser.add_argument("started", type=float, help="Unix time at which the process was started")
    parser.add_argument("file", type=Path, help="JSON file to write")
    parser.add_argument("--not_ahead", action="store_true", help="decode no photos ahead of their iteration")
    args, options = parser.parse_known_args()
    ends: list[float] = []
    step = GaussianModel.step

    def timed(model: GaussianModel, *arguments: object) -> None:
        step(model, *arguments)
        if not ends:
            ends.append(time.time())

    GaussianModel.step = timed
    if args.not_ahead:
        ImageStore.prefetch = lambda *_: None
    train.main(options)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    gpu = torch.cuda.max_memory_allocated() if torch.cuda.is_available() else 0
    write_json(args.file, {"first": ends[0] - args.started, "peak": peak, "gpu": gpu})


if __name__ == "__main__":
    main()
