"""Frames a second of view.py, and milliseconds from a movement to its picture.

    python -m benchmarks.viewing.frames -m MODEL [MODEL ...] [--size 1280 720] [--seconds 5]

The browser's stand-in (browser.py) is another process: it decodes pictures, as a browser does, and draws nothing.
"to sent": from the camera's message to the picture that is handed to the network, in the page's process. "round trip":
from the camera's message to the decoded picture, in the browser's.
"""

import argparse
import json
import statistics
import subprocess
import sys
import threading
from pathlib import Path

from arguments import ModelParams, PipelineParams, read_stored_options
from benchmarks.harness.environment import describe, print_table
from scene.saved_model import load_saved
from utils.system_utils import compute_device, run_cli
from viewing.options import Address
from viewing.page import Page
from viewing.saved import answer

HEADER = ["model", "Gaussians", "window", "frames/s moving", "to sent (ms)", "round trip (ms)", "worst of 20 (ms)"]


def load(model: Path) -> tuple:
    """The scene and the pipeline options of a saved model."""
    parser = argparse.ArgumentParser()
    groups = ModelParams(parser), PipelineParams(parser)
    stored = argparse.Namespace(**read_stored_options(model) | {"model_path": str(model)})
    options, pipe = (group.extract(stored) for group in groups)
    return load_saved(options, -1), pipe


def measure(model: Path, size: list[int], seconds: float) -> list[str]:
    """A row of the table."""
    scene, pipe = load(model)
    page = Page(Address("127.0.0.1", 0), scene, pipe, False, False)
    done = threading.Event()

    def serve() -> None:
        while not done.is_set():
            answer(page)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        words = [sys.executable, "-m", "benchmarks.viewing.browser", page.url, "--seconds", str(seconds)]
        said = subprocess.run([*words, "--size", *map(str, size)], check=True, capture_output=True, text=True)
    finally:
        done.set()
        page.watchers.wake()
        thread.join()
        page.stop()
    seen = json.loads(said.stdout)
    trips, sent = sorted(seen["round_trips"]), statistics.median(page.latency)
    return [
        model.name,
        f"{len(scene.gaussians):,}",
        f"{size[0]} x {size[1]}",
        f"{seen['pictures'] / seen['seconds']:.1f}",
        f"{1e3 * sent:.1f}",
        f"{1e3 * statistics.median(trips):.1f}",
        f"{1e3 * trips[-1]:.1f}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-m", "--models", type=Path, nargs="+", required=True, help="folders of trained models")
    parser.add_argument("--size", type=int, nargs=2, default=[1280, 720], metavar=("W", "H"), help="of the window")
    parser.add_argument("--seconds", type=float, default=5.0, help="length of the orbit (default: 5)")
    args = parser.parse_args()
    rows = [measure(model, args.size, args.seconds) for model in args.models]
    print(f"{describe(compute_device())}\n")
    print_table(HEADER, rows)


if __name__ == "__main__":
    run_cli(main)
