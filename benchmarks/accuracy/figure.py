"""Draw error against run time, from the file that `benchmarks.accuracy.oracle --json` wrote.

python -m benchmarks.accuracy.figure accuracy.json accuracy.png
"""

import argparse
import json
from pathlib import Path

from utils.system_utils import atomic_write, run_cli

COLORS = {"CPU float32": "tab:blue", "CPU float64": "tab:green", "CUDA float32": "tab:red"}
MARKERS = {
    "color": "o",
    "d means": "s",
    "d opacities": "D",
    "d scales": "^",
    "d rotations": "v",
    "d sh_dc": "<",
    "d sh_rest": ">",
    "d screen mean": "h",
}


def draw(measured: dict, path: Path) -> None:
    """Draw a panel per scene and antialiasing setting; each kernel is a column of marks at its run time."""
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.ticker import LogFormatter

    records = measured["records"]
    sizes = {scene: measured["timed sizes"][scene] for scene in dict.fromkeys(r["scene"] for r in records)}
    figure = Figure(figsize=(15, 10), layout="constrained")
    panels = figure.subplots(2, len(sizes), sharex="col", sharey=True)
    for row, antialiasing in enumerate((False, True)):
        for panel, scene in zip(panels[row], sizes, strict=True):
            times = [r["milliseconds"] for r in records if r["scene"] == scene]  # both rows share the time axis
            for record in records:
                if (record["scene"], record["antialiasing"]) == (scene, antialiasing):
                    _draw_record(panel, record, (max(times) / min(times)) ** 0.01)
            panel.set(xscale="log", yscale="log")
            panel.xaxis.set_major_formatter(LogFormatter())
            panel.xaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1, 0.4)))
            panel.set_title(f"{scene}, antialiasing {'on' if antialiasing else 'off'}")
            panel.grid(alpha=0.3)
        panels[row][0].set_ylabel("error against the float64 oracle, on a small scene")
    for panel, (splats, width, height) in zip(panels[1], sizes.values(), strict=True):
        panel.set_xlabel(f"ms, forward + backward, {splats:,} splats at {width}x{height}")
    kernels = dict.fromkeys(r["kernel"] for r in records)
    handles = [Line2D([], [], color=COLORS[kernel], linewidth=4, label=kernel) for kernel in kernels]
    handles.append(Line2D([], [], color="gray", marker="_", linestyle="", label="median, unless 0 (above it: largest)"))
    handles += [Line2D([], [], color="black", marker=mark, linestyle="", label=name) for name, mark in MARKERS.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=7)
    figure.suptitle("Error against run time of the rasterizer\n" + "\n".join(measured["machines"]), fontsize=10)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _draw_record(panel, record: dict, apart: float) -> None:
    """Draw the run's quantities next to each other around its time, each from its median to its largest error.

    apart: ratio of the positions of neighbours on the logarithmic axis.
    """
    color = COLORS[record["kernel"]]
    for i, (name, marker) in enumerate(MARKERS.items()):
        x = record["milliseconds"] * apart ** (i - (len(MARKERS) - 1) / 2)
        largest, median = record["errors"][name]
        if median > 0:
            panel.plot([x, x], [median, largest], color=color, linewidth=0.6, alpha=0.5)
            panel.plot(x, median, marker="_", color=color, markersize=5)
        panel.plot(x, largest, marker=marker, color=color, markersize=5, linestyle="")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("measured", type=Path, help="file written by benchmarks.accuracy.oracle --json")
    parser.add_argument("figure", type=Path, help="image file to write")
    args = parser.parse_args()
    draw(json.loads(args.measured.read_text()), args.figure)


if __name__ == "__main__":
    run_cli(main)
