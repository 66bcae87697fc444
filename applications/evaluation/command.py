"""Train, render and score a table of scenes, and write one report.

python full_eval.py -m360 DIR -tat DIR -db DIR [--output_path DIR]
python full_eval.py --scenes FOLDER ... [--iterations N] [--seeds 0 1 2] [--configs FILE] [--gpus 0 1] [-- OPTIONS]

Writes report.html, .md, .json, .csv and .tex, figures/ and timing.txt into the output folder, and a model folder for
every run: <scene>[/<option set>][/seed_N]; with --html_models also models/, each model as one HTML file. After an
interruption, the same command resumes. Another command with the same output folder adds its runs to the report.
"""

from __future__ import annotations

import os
import sys
import time
from argparse import Namespace
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import groundwork.host.openmp  # noqa: F401  isort: skip  (before torch)

from applications.evaluation import plan, stages
from applications.evaluation.child import Finished, Slot, run_child, share_gpus
from applications.evaluation.configs import check_options, list_shipped, read_configs
from applications.evaluation.plan import Run, SceneEntry
from applications.evaluation.report import make_report, write_report
from applications.evaluation.results import read_earlier, read_run
from applications.evaluation.stages import Failure, StageFailed
from applications.evaluation.tables import MAIN, Table, make_gains_table, make_result_tables
from arguments import OptionParser
from groundwork.files.folders import locked
from groundwork.host.listing import markdown_table
from groundwork.host.machine import facts_from_process
from splatting.records.error_curve import peers_of
from utils.system_utils import UserError, mkdir_p

EXPOSURE = (
    "--exposure_lr_init", "0.001", "--exposure_lr_final", "0.0001", "--exposure_lr_delay_steps", "5000",
    "--exposure_lr_delay_mult", "0.001", "--train_test_exp",
)  # fmt: skip
Start = Callable[..., Finished]  # child.run_child, or what stands in for it
_SHORT_FOR = {  # flags: words for train.py that they stand for, and help
    "use_depth": (("-d", "depths2/"), "supervise with inverse depth maps: train.py -d depths2/"),
    "use_expcomp": (EXPOSURE, "exposure compensation: train.py --train_test_exp and its learning rates"),
    "fast": (("--optimizer_type", "sparse_adam"), "train.py --optimizer_type sparse_adam"),
    "aa": (("--antialiasing",), "train and render with --antialiasing"),
}


def _make_parser() -> OptionParser:
    """Make the parser of the command line."""
    parser = OptionParser(
        description=__doc__.splitlines()[0],
        epilog="Options after -- go to train.py. A training counts as finished if it used the same scene folder and "
        "the same options of train.py, with any version of the code; a changed dataset is not detected. Exit status: 1 "
        "if a run failed or nothing was scored, 2 if nothing could be started.",
    )
    add = parser.add_argument
    flag = {"action": "store_true"}
    add("--mipnerf360", "-m360", type=Path, metavar="DIR", help="folder with the nine scenes of Mip-NeRF 360")
    add("--tanksandtemples", "-tat", type=Path, metavar="DIR", help="folder with truck and train of Tanks and Temples")
    add("--deepblending", "-db", type=Path, metavar="DIR", help="folder with drjohnson and playroom of Deep Blending")
    add("--resize", **flag,
        help="Mip-NeRF 360: train on the full photos, made smaller by train.py's -r 4 or -r 2; scores are about 0.5 dB "
        "higher than with the data set's own JPEGs in images_4 and images_2 (default: these)")  # fmt: skip
    add("--scenes", type=Path, nargs="+", default=[], metavar="FOLDER",
        help="any COLMAP, Blender or nerfstudio folders; Blender scenes get train.py's -w, as in published "
        "tables")  # fmt: skip
    add("--output_path", type=Path, default=Path("./eval"), metavar="DIR", help="models and report (default: ./eval)")
    add("--skip_training", **flag, help="use the models in the output folder, whatever made them")
    add("--skip_rendering", **flag, help="use the existing renders")
    add("--skip_metrics", **flag, help="use the existing scores")
    add("--gpus", type=int, nargs="+", default=[], metavar="N",
        help="share the runs among the GPUs with these numbers, one run on each at a time; a number given twice takes "
        "two, whose seconds then tell little (default: one run after another, on the first)")  # fmt: skip
    add("--iterations", type=int, metavar="N", help="training steps (default: train.py's, 30000)")
    add("--seeds", type=int, nargs="+", default=[], metavar="N",
        help="train with each of these seeds and report mean and standard deviation (default: once)")  # fmt: skip
    add("--configs", type=Path, metavar="FILE",
        help='train with each option set of a JSON file, {"name": ["--sh_degree", "1"], ...}, and compare them; '
        f"{' or '.join(list_shipped())} names a file that comes with this program (default: once)")  # fmt: skip
    add("--peer", nargs=2, action="append", default=[], metavar=("NAME", "FILE"),
        help="draw another program's error against time beside ours, from a CSV file with the columns seconds and "
        "test_psnr (`python -m applications.evaluation.peer_curve` makes it); with several "
        "scenes NAME is SCENE/NAME; may be given "
        "again (default: none)")  # fmt: skip
    add("--weights", type=Path, metavar="FOLDER",
        help="folder of the weights of LPIPS and DISTS, as for metrics.py (default: none, and no DISTS)")  # fmt: skip
    add("--stlpips", **flag, help="also score ST-LPIPS, as metrics.py does with --stlpips")
    add("--html_models", **flag,
        help="write each model into models/ beside the report, as one HTML file with a viewer")  # fmt: skip
    for name, (_, text) in _SHORT_FOR.items():
        add(f"--{name}", **flag, help=text)
    return parser


def _list_scenes(args: Namespace) -> list[SceneEntry]:
    """List the scenes of the data sets and folders that the options name. UserError for unusable ones."""
    groups = ("mipnerf360", "tanksandtemples", "deepblending")
    roots = [(group, root) for group in groups if (root := getattr(args, group))]
    scenes = [entry for group, root in roots for entry in plan.dataset_scenes(group, root, args.resize)]
    if args.resize and not args.mipnerf360:
        raise UserError("--resize works with -m360 only; give -m360, or pass -r to train.py after --")
    scenes += plan.folder_scenes(args.scenes)
    if not scenes and args.skip_training and args.skip_rendering:
        scenes = plan.finished_scenes(args.output_path)
    if not scenes:
        raise UserError("no scenes given; pass data sets as -m360, -tat, -db, or folders as --scenes")
    if not args.skip_training and args.scenes:
        from scene.readers.scene_folder import kind_of  # here, as scores alone need no extensions

        for folder in args.scenes:
            kind_of(folder)
    plan.check_names(scenes)
    return scenes


def _plan_all(args: Namespace, more: Sequence[str]) -> list[Run]:
    """Plan the runs; UserError for invalid options, before hours are spent."""
    if args.iterations is not None and args.iterations < 1:
        raise UserError(f"--iterations must be at least 1, got {args.iterations}")
    if min(args.seeds, default=0) < 0 or len(set(args.seeds)) < len(args.seeds):
        raise UserError(f"--seeds must be distinct numbers, 0 or more, got {' '.join(map(str, args.seeds))}")
    if args.weights and not args.skip_metrics:
        from utils.lpips_utils import weights_file  # here, as it imports torchvision

        weights_file("vgg", args.weights)
    if args.stlpips and not args.skip_metrics:
        from utils.lpips_utils import import_stlpips  # as above

        import_stlpips()
    parse = None if args.skip_training else _parse_for_training
    check_options(more, "after --", parse)
    configs = read_configs(args.configs, parse) if args.configs else {}
    common = [word for name, (words, _) in _SHORT_FOR.items() if getattr(args, name) for word in words]
    common += [*([] if args.iterations is None else ["--iterations", str(args.iterations)]), *more]
    if args.seeds and any(word.split("=")[0] == "--seed" for word in (*common, *sum(configs.values(), ()))):
        raise UserError("--seed is given twice; omit it when --seeds is given")
    runs = plan.plan_runs(_list_scenes(args), args.output_path.resolve(), common, configs, args.seeds)
    plan.check_outside_scenes(runs)
    plan.check_nesting(runs, args.output_path.resolve())
    if not args.skip_training:
        plan.check_photos(runs)
        plan.check_folders(runs)
    return runs


def _parse_for_training(words: Sequence[str]) -> tuple[Namespace, ...]:
    """Return train.py's groups of options, parsed from the words of a command line."""
    from splatting.commands import (
        train,  # imported here because scoring existing models may happen on a machine without the extensions
    )

    return train.parse(words)


def _map_gpus(gpus: Sequence[int]) -> list[str]:
    """Return the value of CUDA_VISIBLE_DEVICES for each of these GPUs. UserError if there is no such GPU."""
    if not gpus:
        return []
    import torch  # here, as it takes a second

    count = torch.cuda.device_count()
    if wrong := [gpu for gpu in gpus if not 0 <= gpu < count]:
        there = f"it has {count}, from 0 on" if count else "torch finds none here; leave --gpus out"
        raise UserError(f"--gpus: this machine has no GPU {wrong[0]}; {there}")
    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    return [given.split(",")[gpu] if given else str(gpu) for gpu in gpus]


def _complete_runs(
    runs: Sequence[Run], args: Namespace, gpus: Sequence[str], failures: dict[Run, Failure], start: Start
) -> None:
    """Train, render and score every run, without the stages that options skip; a failed run does not stop the others.

    gpus: values of CUDA_VISIBLE_DEVICES, among which the runs are shared; empty: one run after the other.
    failures: receives the failure of each run that fails, which is printed, too.
    start: runs the command of a stage.
    """
    facts = {} if args.skip_training else facts_from_process()
    options = _SHORT_FOR["aa"][0] if args.aa else ()
    download = True

    def complete(numbered: tuple[int, Run], slot: Slot | None = None) -> None:
        """Train, render and score one run, and print how it ended.

        numbered: its number from 1 on, and the run.
        slot: the GPU to use; None: the first one.
        """
        nonlocal download
        number, run = numbered
        begun, child = time.perf_counter(), partial(start, slot=slot)
        head = f"[{number}/{len(runs)}] {run.title}"
        _print_line(f"{head}: on GPU {slot.gpu}" if slot else head)
        try:
            if not args.skip_training:
                stages.train(run, facts, child)
            if not args.skip_rendering:
                stages.render(run, options, child)
            if not args.skip_metrics:
                download = stages.score(run, child, download, args.weights, args.stlpips)
            if args.html_models:
                stages.write_page(run, args.output_path.resolve(), options, child)
            end = f"finished in {time.perf_counter() - begun:.0f} s"
        except StageFailed as failed:
            failures[run] = failed.failure
            end = f"FAILED ({failed.failure.stage}): {failed}"
        _print_line(f"{head}: {end}" if slot else f"  {end}")

    if gpus:
        share_gpus(enumerate(runs, 1), gpus, complete)
    else:
        for numbered in enumerate(runs, 1):
            complete(numbered)


def _print_line(line: str) -> None:
    """Print a line at once and whole, as other threads print, too."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _write_report(
    command: Sequence[str], runs: Sequence[Run], failures: dict[Run, Failure], peers: list[dict[str, Any]], output: Path
) -> bool:
    """Write and print the report of these runs and those of earlier calls; return whether any of these has scores.

    If none has, a report with scores stays as it is.
    """
    earlier = read_earlier(output)
    every = earlier["runs"] | {run.model: (run, failures.get(run)) for run in runs}  # of both, that of this call
    results = [read_run(run, output, failure) for run, failure in every.values()]
    models = {os.path.relpath(run.model, output) for run in runs}
    scored = any(result["final_iteration"] is not None for result in results if result["model"] in models)
    if not scored:
        stays = f"; the report of an earlier call stays: {output / 'report.html'}" if earlier["scored"] else ""
        print(f"nothing was scored{stays}", file=sys.stderr)
        if earlier["scored"]:
            return False
    scenes = {result["scene"] for result in results}
    named = {(peer["scene"], peer["name"]): peer for peer in (*earlier["peers"], *peers) if peer["scene"] in scenes}
    report = make_report(command, results, list(named.values()), earlier["commands"])
    write_report(report, output)
    for table in make_result_tables([*report["summary"], *report["means"]], MAIN):
        print(f"\n{table.title}\n{_format_table(table)}" if table.title else _format_table(table))
    for scene, found in report["gains"].items():
        title = f"{scene}: gain in test PSNR over {found['default']} on the same seeds"
        print(f"\n{title}\n{_format_table(make_gains_table(found))}")
    print(f"\nreport: {output / 'report.html'}")
    return scored


def _format_table(table: Table) -> str:
    return markdown_table(table.header, table.rows)


def main(argv: Sequence[str] | None = None, start: Start = run_child) -> None:
    """Run the command line. start: how a stage's command is run."""
    words = list(sys.argv[1:] if argv is None else argv)
    end = words.index("--") if "--" in words else len(words)
    args = _make_parser().parse_args(words[:end])
    runs = _plan_all(args, words[end + 1 :])
    peers = peers_of(args.peer, list(dict.fromkeys(run.scene.name for run in runs)))
    gpus, output = _map_gpus(args.gpus), args.output_path.resolve()
    mkdir_p(output)
    failures: dict[Run, Failure] = {}
    busy = "full_eval.py (process {process}), or a training that it started,"
    with locked(output, "full_eval.py", busy, "--output_path", inherited=True):
        try:
            _complete_runs(runs, args, gpus, failures, start)
        finally:  # report the finished runs after Ctrl-C too
            scored = _write_report(["full_eval.py", *words], runs, failures, peers, output)
    if failures:
        print(
            f"{len(failures)} of {len(runs)} runs failed: {', '.join(run.title for run in failures)}", file=sys.stderr
        )
    if failures or not scored:
        sys.exit(1)
