"""Train a Gaussian model: photos with cameras and sparse points in, point_cloud.ply out.

python train.py -s SCENE -m OUT --eval
"""

import argparse
import sys
from collections.abc import Sequence
from typing import Any

import groundwork.host.openmp  # noqa: F401  isort: skip  (before torch)
import torch

from arguments import write_cfg_args, write_model_json
from arguments.launch import launch_options, training_parser
from groundwork.applications import application
from scene.checks.conversion import awaits_conversion
from scene.images.store import image_device
from splatting.agreement import agree_on_options
from splatting.events import summary_writer
from splatting.folder import folder_of, new_folder, own_folder, records_kept, resolve_lenses
from splatting.loop import run_training, standard_observers
from splatting.make_run import make_run
from splatting.plan import check_before_scene
from splatting.registry import PARTS, check_together, chosen
from splatting.resume import choose_checkpoint
from splatting.scores import training_report
from utils.general_utils import safe_state
from utils.system_utils import UserError, check_folder_can_be_made, compute_device, mkdir_p

__all__ = ["main", "parse", "prepare_output_and_logger", "train", "training", "training_report"]


def train(
    dataset: argparse.Namespace, opt: argparse.Namespace, pipe: argparse.Namespace, launch: argparse.Namespace
) -> None:
    """Train from the options of the three groups; write model, checkpoints and log to dataset.model_path.

    launch: the options of arguments/launch.py.
    """
    if not _has_more_to_train(dataset, opt, launch):
        return
    dataset.model_path = dataset.model_path or folder_of(launch.start_checkpoint) or new_folder(dataset.source_path)
    run = make_run(dataset, opt, pipe, launch)
    if not run.start:
        print(f"Optimizing {dataset.model_path}")
    else:
        print(f"Resuming {dataset.model_path} at iteration {run.first_iteration}")
    # Write nothing before every input check has passed: a mistyped option must not overwrite a finished model.
    with own_folder(folder := dataset.model_path), records_kept(folder), run.resources:
        writer = prepare_output_and_logger(run.options, **run.entries) if run.group.first else None
        run.open(writer, training_report)
        run_training(run, standard_observers(run))


def training(
    dataset: argparse.Namespace,
    opt: argparse.Namespace,
    pipe: argparse.Namespace,
    testing_iterations: Sequence[int],
    saving_iterations: Sequence[int],
    checkpoint_iterations: Sequence[int],
    checkpoint: str | None,
    debug_from: int = -1,
    **launch: Any,
) -> None:
    """Call `train`, with the parameters of the reference's function of this name.

    launch: other options of the launch. Without any, a remote viewer is served only if network_gui listens.
    """
    named = {"test_iterations": testing_iterations, "save_iterations": saving_iterations, "debug_from": debug_from}
    named |= {"checkpoint_iterations": checkpoint_iterations, "start_checkpoint": checkpoint}
    train(dataset, opt, pipe, launch_options(**named | launch))


def prepare_output_and_logger(args: argparse.Namespace, **entries: Any) -> Any | None:
    """Make the output folder, args.model_path, with cfg_args and model.json (as write_model_json takes args, entries).

    An empty model_path becomes that of a new folder. Returns a TensorBoard writer, or None without TensorBoard.
    """
    args.model_path = args.model_path or new_folder(getattr(args, "source_path", ""))
    print(f"Output folder: {args.model_path}")
    mkdir_p(args.model_path)
    write_cfg_args(args.model_path, args)
    write_model_json(args.model_path, args, **entries)
    return summary_writer(args.model_path)


def parse(argv: Sequence[str] | None = None) -> tuple[argparse.Namespace, ...]:
    """Parse the command line: all options, and those of the groups model, optimisation and pipeline.

    UserError for a value out of range; argparse ends the program at a word that it does not know.
    """
    parser, groups = training_parser()
    args = parser.parse_args(argv)
    options = [group.extract(args) for group in groups]
    for name in ("test_iterations", "save_iterations", "checkpoint_iterations"):
        if wrong := [t for t in getattr(args, name) if t < 1 and t != -1]:
            raise UserError(f"--{name} takes iterations from 1 on, or -1 for none, got {wrong[0]}")
    check_together(chosen(args), args, several=False)
    return args, *options


def _has_more_to_train(dataset: argparse.Namespace, opt: argparse.Namespace, launch: argparse.Namespace) -> bool:
    """Choose the checkpoint of --resume. Return False where the training that it names is finished."""
    stops = {option: continues for part in PARTS for option, continues in part.ends_by.items()}
    return choose_checkpoint(dataset, opt, launch, stops)


def _is_worth_converting(
    dataset: argparse.Namespace, opt: argparse.Namespace, pipe: argparse.Namespace, launch: argparse.Namespace
) -> bool:
    """Refuse what a training would refuse after a conversion (UserError). Return False if there is nothing to train."""
    image_device(dataset.data_device, compute_device(), warn=True)
    if not _has_more_to_train(dataset, opt, launch):
        return False
    check_before_scene(dataset, opt, pipe, launch)
    if dataset.model_path:
        check_folder_can_be_made(dataset.model_path)
    return True


def main(argv: Sequence[str] | None = None) -> None:
    """Train as the command line says."""
    args, dataset, opt, pipe = parse(argv)
    if dataset.source_path and awaits_conversion(dataset.source_path):
        if not _is_worth_converting(dataset, opt, pipe, args):
            return
        application("convert", "command").convert_first(dataset.source_path)
    if args.advise or args.options == "auto":
        given = sys.argv[1:] if argv is None else argv
        words = application("doctor", "advice").asked_options(resolve_lenses(dataset, None), args, given)
        if args.advise:
            return
        args, dataset, opt, pipe = parse([*words, *given])
    safe_state(args.quiet, opt.seed)
    agree_on_options(args)
    torch.autograd.set_detect_anomaly(args.detect_anomaly)
    args.save_iterations = [*args.save_iterations, opt.iterations]
    train(dataset, opt, pipe, args)
    print("Training complete.")
