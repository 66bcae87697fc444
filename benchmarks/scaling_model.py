"""Arithmetic of training over several GPUs: bytes, largest scenes and times of a step. It measures nothing.

    python -m benchmarks.scaling_model [--write docs/inside/scaling.md]

That page explains the formulas. Bytes are those of the code; times are predictions
from stages that were measured on one H200 (docs/results/kernels.md) and from links that were measured or assumed.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

from benchmarks.harness.environment import table
from benchmarks.harness.page import check_marks, write_tables
from utils.system_utils import run_cli

TILE = 16  # pixels

# Bytes of a Gaussian that its rank holds from step to step.
PARAMETERS, MOMENTS, STATISTICS = 4 * 59, 2 * 4 * 59, 4 * 3
SH_REST = 4 * 45  # of the parameters
SPILLED = 3 * SH_REST  # with its moments
HELD = PARAMETERS + MOMENTS + STATISTICS
# Bytes of a Gaussian that projection leaves until the step ends: splat, depth, rectangle, tile count, radius.
PROJECTED = 40 + 4 + 16 + 4 + 4
TILE_RECORD = 16  # while projection runs, and again on a rank that bins what it received
RECORD = 40 + 4 + 16 + 4  # of a visible Gaussian, sent to each band that it reaches
COUNT = 4  # of gradient rows, sent back for each record
PLACE, MARK = 28, 4  # of a record and of a row, while rows are added up and put in order
LISTED = 15  # of a Gaussian: room for the list of records, 12 bytes each, and a quarter more
ROW = 40  # of gradients: the sum of a Gaussian's, sent back if it has any; 48 with absolute gradients
BIN_SPLAT, SLOTS_SPLAT = 44, 16  # of a record while binning: keys, orders, offsets and memory of the sort; its slots
BIN_INSTANCE, INSTANCE = 18, 4  # while binning: keys twice, splats twice, memory of the sort; afterwards
SLOT = 0.25  # a bit, and its share of the prefix sums
IMAGE = 12  # of a pixel: colour
PHOTO = 3  # of a pixel, from the rank that keeps the photo
PIXEL = 57 + 72 + 3 * IMAGE  # training/memory_estimate.py, and an image's copies on its way to all ranks

HALO = 10  # rows on each side of a band: SSIM reads 5, and so does its gradient (REACH of fused_ssim)

USABLE, RUNTIME = 0.92, 2e9  # of a GPU's memory, fragmentation left out; CUDA, NCCL and torch

# Links, bytes a second that a GPU sends, and seconds of a call whatever it carries.
NVLINK = 330e9  # fitted to all_to_all on 2 and 4 H200
CALL = 40e-6
NIC = 0.8 * 400e9 / 8  # a link of 400 Gbit/s at an assumed 80 %
PCIE = 50e9  # assumed of a Gen5 x16 slot, each way at once
MEMORY = 3.0e12  # bytes a second that copies move on a GPU, read and written: 70 % of the 4.3 TB/s of a plain copy

WAIT = 20e-6  # assumed: the host reads a number of the GPU, which then waits for the next kernel
OPERATOR = 10e-6  # assumed: a small operator of torch, from Python
VIEW_OPERATORS = 30  # of each view in a batch; counted for two


@dataclass(frozen=True)
class Workload:
    """What a step of a view has to do. Numbers are of the view, means of its seen Gaussians."""

    name: str
    gaussians: float
    seen: float
    instances: float
    processed: float
    returned: float  # seen Gaussians with a processed instance
    width: int
    height: int
    rows: float = 1.73  # rows of tiles of a rectangle
    slots: float = 3.43  # tiles of a rectangle

    @property
    def pixels(self) -> int:
        return self.width * self.height

    @property
    def tile_rows(self) -> int:
        return -(-self.height // TILE)


# Measured: Gaussians, instances and processed instances of XL (docs/results/kernels.md), and how many Gaussians these
# are of (by the bytes of docs/results/several_gpus.md); its rectangles were counted on 200,000 splats of the same
# distribution. The others are assumed; 0.485 Gaussians for each processed instance were measured on another city.
XL = Workload("XL, 6 M, 1600x1060", 6e6, 5.86e6, 17.25e6, 2.69e6, 1.03e6, 1600, 1060)
LARGE = Workload("20 M, 3840x2160", 20e6, 10e6, 29.5e6, 9e6, 4.37e6, 3840, 2160)
CITY = Workload("a city, 200 M, 3840x2160", 200e6, 4e6, 11.8e6, 7.5e6, 3.64e6, 3840, 2160)
SCENES = (XL, LARGE, CITY)


@dataclass(frozen=True)
class Machine:
    """GPUs in nodes; network: bytes a second that a GPU sends out of its node."""

    name: str
    gpus: int
    nodes: int = 1
    network: float = NIC


MACHINES = (
    *(Machine(f"{gpus}", gpus) for gpus in (1, 2, 4, 8)),
    Machine("2 x 8, a link a GPU", 16, 2),
    Machine("2 x 8, a link a node", 16, 2, NIC / 8),
)


@dataclass(frozen=True)
class Design:
    """How a step over tiles is done. The first two are the code; the third says what else could be had."""

    name: str
    whole_image: bool  # every rank gets it, and takes the whole loss; else a halo of HALO rows
    waits: int  # of the host for numbers of the GPU, which has nothing to do meanwhile
    calls: int  # collective ones (STEP and WHOLE_STEP of tests/test_ranks_training.py)
    operators: int  # small ones, whatever the number of ranks


AS_WRITTEN = Design("as written", False, 2, 7, 42)  # operators that compute or copy, counted at commit 5418e62
WHOLE_IMAGE = Design("whole image", True, 2, 6, 42)
LEAN = Design("lean", False, 0, 4, 0)
DESIGNS = (AS_WRITTEN, WHOLE_IMAGE, LEAN)

GROWTHS = (1.2, 1.96)  # of a square block: by borders of a twentieth and a fifth of its side


def bands_crossed(scene: Workload, gpus: int) -> float:
    """Bands that a seen Gaussian's rectangle reaches on average: each border is one of the image's rows of tiles."""
    return 1 + (scene.rows - 1) * (gpus - 1) / max(scene.tile_rows - 1, 1)


def tiles_traffic(scene: Workload, gpus: int, design: Design = AS_WRITTEN) -> dict[str, float]:
    """Bytes that a rank sends to others in a step of --parallel tiles, on average."""
    away = (gpus - 1) / gpus  # Gaussians lie in no order of the image
    records = scene.seen * bands_crossed(scene, gpus) / gpus * away
    halo = 0 if gpus == 1 else 2 * HALO * scene.width * 12
    return {
        "records": RECORD * records,
        "image": IMAGE * scene.pixels * away if design.whole_image else halo,
        "rows": ROW * scene.returned / gpus * away,
        "counts": COUNT * records,
        "photo": PHOTO * scene.pixels * away,
    }


def views_traffic(scene: Workload, gpus: int) -> dict[str, float]:
    """Bytes that a rank sends to others in a step of --parallel views, which has a view for each rank."""
    away = (gpus - 1) / gpus
    sizes = {"records": RECORD * scene.seen, "rows": ROW * scene.returned, "counts": COUNT * scene.seen}
    return {name: size * away for name, size in sizes.items()}


def leaving_share(machine: Machine) -> float:
    """Share of what a rank sends that goes to another node."""
    per_node = machine.gpus // machine.nodes
    return 0.0 if machine.gpus == 1 else (machine.gpus - per_node) / (machine.gpus - 1)


def exchange_seconds(machine: Machine, sent: float, calls: int) -> float:
    """Seconds that `calls` exchanges take in which a rank sends so many bytes; NVLink and network work at once."""
    if machine.gpus == 1:
        return 0.0
    out = sent * leaving_share(machine)
    return calls * CALL + max((sent - out) / NVLINK, out / machine.network)


def stages(gaussians: float, seen: float, splats: float, instances: float, processed: float, pixels: float) -> dict:
    """Milliseconds of a step's stages on one H200.

    Fitted to M+, L and XL (docs/results/kernels.md, tried.md). splats: those that are binned. A Gaussian that is not
    seen saves its SH in projection, and its rows.
    """
    n, s, b, i, p, px = (x / 1e6 for x in (gaussians, seen, splats, instances, processed, pixels))
    return {
        "project": 0.026 + 0.087 * s + 0.022 * (n - s),
        "bin": 0.078 + 0.074 * b + 0.027 * i,
        "blend": 0.083 * px + 0.092 * p,
        "loss": 0.071 * px,
        "blend_vjp": 0.110 * px + 0.285 * p,
        "project_vjp, Adam": 0.52 * s + 0.47 * (n - s),
    }


def tiles_step(scene: Workload, machine: Machine, design: Design = AS_WRITTEN) -> dict[str, float]:
    """Predicted milliseconds of the parts of a step of --parallel tiles."""
    gpus = machine.gpus
    own, crossed = 1 / gpus, bands_crossed(scene, gpus)
    if gpus == 1:
        splats = scene.gaussians
        return stages(scene.gaussians, scene.seen, splats, scene.instances, scene.processed, scene.pixels)
    # A band is cut between rows of tiles, so it may have a row more than its share.
    band = own * (1 + gpus / scene.tile_rows)
    splats, instances = scene.seen * crossed * band, scene.instances * crossed * band
    parts = stages(
        scene.gaussians * own, scene.seen * own, splats, instances, scene.processed * band, scene.pixels * band
    )
    if design.whole_image:
        parts["loss"] = stages(0, 0, 0, 0, 0, scene.pixels)["loss"]
    sent = tiles_traffic(scene, gpus, design)
    # Of a byte: packed, joined, received, put into its place, each read and written.
    copied = 8 * (sum(sent.values()) - sent["image"]) + 8 * (IMAGE * scene.pixels if design.whole_image else 0)
    parts["copies"] = 1e3 * copied / MEMORY
    parts["exchange"] = 1e3 * exchange_seconds(machine, sum(sent.values()), design.calls)
    parts["host"] = 1e3 * (design.waits * WAIT + design.operators * OPERATOR)
    return parts


def views_step(scene: Workload, machine: Machine) -> dict[str, float]:
    """Predicted milliseconds of the parts of a step of --parallel views, of as many images as there are GPUs."""
    gpus, n = machine.gpus, scene.gaussians / 1e6
    if gpus == 1:
        return tiles_step(scene, machine)
    parts = stages(scene.gaussians, scene.seen, scene.seen, scene.instances, scene.processed, scene.pixels)
    parts["project"] += 0.026 * (gpus - 1)  # all views, of a shard each
    del parts["project_vjp, Adam"]
    # project_vjp of every view of a shard. The first writes all gradients, the others read and write those they change.
    summed = scene.gaussians / gpus + 2 * scene.seen * (gpus - 1) / gpus
    parts["project_vjp"] = 0.19 * scene.seen / 1e6 + 1e3 * PARAMETERS * summed / MEMORY
    parts["Adam"] = 0.534 * n / gpus
    sent = sum(views_traffic(scene, gpus).values())
    parts["copies"] = 1e3 * 8 * sent / MEMORY
    parts["exchange"] = 1e3 * exchange_seconds(machine, sent, 5)
    parts["host"] = 1e3 * (4 * WAIT + VIEW_OPERATORS * OPERATOR * gpus)
    return parts


def blocks_step(scene: Workload, blocks: int, growth: float) -> tuple[dict[str, float], float]:
    """Predicted milliseconds of a step of a block on a GPU by itself, and how many views all blocks train in that time.

    growth: of a block with the border that it shares with others. A view counts once, though several blocks train it.
    """
    own = scene.gaussians * growth / blocks
    seen = min(scene.seen, own)
    return stages(own, seen, own, scene.instances, scene.processed, scene.pixels), blocks / growth


def step_bytes(scene: Workload, gpus: int) -> float:
    """Largest bytes a Gaussian that a step of --parallel tiles needs on a rank besides what is held."""
    share = scene.seen / scene.gaussians
    records = share * bands_crossed(scene, gpus)
    instances, processed = scene.instances / scene.gaussians, scene.processed / scene.gaussians
    returned = scene.returned / scene.gaussians
    if gpus == 1:
        splats, arrived = 1.0, 0.0
    else:
        splats, arrived = records, RECORD * records
    # Packed and joined, received, unpacked: at most three at once, of which the last becomes `arrived`.
    exchange = 2 * arrived
    made = TILE_RECORD if gpus > 1 else 0
    binning = (BIN_SPLAT + SLOTS_SPLAT + made) * splats + BIN_INSTANCE * instances
    lists = SLOTS_SPLAT * splats + INSTANCE * instances + SLOT * scene.slots * share
    rows = ROW * processed
    if gpus > 1:
        # Made, and room for the sums; received and put in order.
        rows = 2 * rows + (2 * ROW + MARK) * returned + PLACE * records
    return PROJECTED + (LISTED if gpus > 1 else 0) + max(TILE_RECORD, arrived + max(exchange, binning, lists + rows))


def peak_bytes(scene: Workload, gpus: int, spill: bool = False) -> float:
    """Bytes a Gaussian of a rank's shard at the peak of a step; with spill the rows of two views lie on the GPU."""
    held = HELD - SPILLED + 2 * SPILLED * scene.seen / scene.gaussians if spill else HELD
    return min(held, HELD) + step_bytes(scene, gpus)


def largest(scene: Workload, gpus: int, memory: float, spill: bool = False) -> float:
    """Largest number of Gaussians of scenes like this one, on GPUs of `memory` bytes."""
    room = USABLE * memory - RUNTIME - PIXEL * scene.pixels
    return gpus * room / peak_bytes(scene, gpus, spill)


def spill_milliseconds(seen: float, gpus: int) -> float:
    """Milliseconds a step that the spilled rows of a view need on the bus of each GPU, each way."""
    return 1e3 * SPILLED * seen / gpus / PCIE


def stage_table() -> list[str]:
    """Stages of a step on one GPU."""
    rows = []
    for scene in SCENES:
        parts = tiles_step(scene, MACHINES[0])
        rows.append([scene.name, *(f"{ms:.2f}" for ms in parts.values()), f"{sum(parts.values()):.1f}"])
    return table(["one GPU, ms", *tiles_step(XL, MACHINES[0]), "step"], rows)


def _like(share: float) -> Workload:
    """A scene of which a view sees a share, with XL's instances of a seen Gaussian."""
    seen = share * 1e8
    return Workload(f"{share:.0%}", 1e8, seen, 2.94 * seen, 0.46 * seen, 0.176 * seen, 3840, 2160)


def peak_table() -> list[str]:
    """Bytes a Gaussian at the peak of a step."""
    rows = []
    for scene in map(_like, (0.02, 0.1, 0.5, 1.0)):
        figures = [peak_bytes(scene, gpus, spill) for gpus in (1, 8) for spill in (False, True)]
        rows.append([scene.name, *(f"{x:,.0f}" for x in figures)])
    return table(["a view sees", "1 GPU", "1 GPU, spill", "8 GPUs, of its shard", "8 GPUs, spill"], rows)


def size_table() -> list[str]:
    """Largest numbers of Gaussians."""
    rows, shares = [], (0.02, 0.1, 0.5)
    for memory in (80e9, 141e9):
        for gpus in (1, 2, 4, 8, 16, 64):
            cells = []
            for scene in map(_like, shares):
                plain, spilled = (largest(scene, gpus, memory, spill) / 1e6 for spill in (False, True))
                with_spill = f"{spilled:,.0f} ({SPILLED * spilled / 1e3:,.0f} GB)" if spilled > plain else "no more"
                cells.append(f"{plain:,.0f} / {with_spill}")
            rows.append([f"{gpus} of {memory / 1e9:.0f} GB", *cells])
    return table(["GPUs", *(f"{share:.0%} seen" for share in shares)], rows)


def traffic_table(scene: Workload) -> list[str]:
    """MB that a GPU sends in a step."""
    rows = []
    for machine in MACHINES[1:5]:
        gpus = machine.gpus
        written, whole = tiles_traffic(scene, gpus), tiles_traffic(scene, gpus, WHOLE_IMAGE)
        cells = [*(written[name] for name in ("records", "rows", "counts", "photo")), whole["image"]]
        cells += [sum(sent.values()) for sent in (written, whole, views_traffic(scene, gpus))]
        needed = cells[5] / (0.25e-3 * _work(tiles_step(scene, machine))) / 1e9
        crossed = f"{bands_crossed(scene, gpus):.3f}"
        rows.append([str(gpus), crossed, *(f"{x / 1e6:,.1f}" for x in cells), f"{needed:,.0f}"])
    parts = ["records", "rows", "counts", "photo", "image"]
    header = ["GPUs", "bands", *parts, "tiles", "tiles, whole image", "views", "GB/s"]
    return table(header, rows)


_BESIDES = ("loss", "copies", "exchange", "host")


def _work(parts: dict[str, float]) -> float:
    return sum(ms for name, ms in parts.items() if name not in _BESIDES)


def step_table(scene: Workload) -> list[str]:
    """Predicted steps on all machines, by all ways."""
    ways = [
        *((f"tiles, {design.name}", tiles_step(scene, m, design), m, 1) for design in DESIGNS for m in MACHINES[1:]),
        *(("views", views_step(scene, m), m, m.gpus) for m in MACHINES[1:]),
    ]
    alone, rows = tiles_step(scene, MACHINES[0]), []
    for way, parts, machine, views in [("", alone, MACHINES[0], 1), *ways]:
        rows.append([way, machine.name, *_cells(parts, views, sum(alone.values()))])
    # Only where a block holds all that a view sees.
    for growth in GROWTHS if scene.seen <= scene.gaussians / 16 else ():
        parts, views = blocks_step(scene, 16, growth)
        rows.append([f"16 blocks, grown {growth} times", "16", *_cells(parts, views, sum(alone.values()))])
    return table(["way", "GPUs", "work", *_BESIDES, "step, ms", "views, of one GPU's"], rows)


def _cells(parts: dict[str, float], views: float, alone: float) -> list[str]:
    besides = [f"{parts[name]:.2f}" if name in parts else "" for name in _BESIDES]
    step = sum(parts.values())
    return [f"{_work(parts):.2f}", *besides, f"{step:.2f}", f"{views * alone / step:.2f}"]


def spill_table() -> list[str]:
    """Milliseconds that the bus needs for spilled rows, each way."""
    counts = (1, 2, 4, 8, 16)
    rows = [[scene.name, *(f"{spill_milliseconds(scene.seen, gpus):.1f}" for gpus in counts)] for scene in SCENES]
    return table(["GPUs", *map(str, counts)], rows)


def tables() -> dict[str, list[str]]:
    """The lines of every table of the page, by the name of its marks."""
    made = {"stages": stage_table(), "peak": peak_table(), "sizes": size_table(), "spill": spill_table()}
    for name, scene in zip(("xl", "large", "city"), SCENES, strict=True):
        made[f"traffic {name}"], made[f"steps {name}"] = traffic_table(scene), step_table(scene)
    return made


def main() -> None:
    """Print the tables, and put them into the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", type=Path, metavar="PAGE", help="put the tables between the page's marks")
    args = parser.parse_args()
    for name, lines in tables().items():
        if args.write:
            check_marks(args.write, name)
            write_tables(args.write, name, lines)
        print("\n".join(["", name, "", *lines]))


if __name__ == "__main__":
    run_cli(main)
