"""Train a Gaussian model: photos with cameras and sparse points in, point_cloud.ply out.

python train.py -s SCENE -m OUT --eval
"""

if __name__ == "__main__":
    import utils.host.early  # noqa: F401  (before the other imports, which take a second)
    import utils.host.early_cuda  # noqa: F401  (while the others are imported)

import argparse
from collections.abc import Sequence
from typing import Any

import utils.host.openmp  # noqa: F401  isort: skip  (before torch)
import torch

from arguments import ModelParams, OptimizationParams, OptionParser, PipelineParams, write_cfg_args, write_model_json
from gaussian_renderer import network_gui
from records.event_writer import EventWriter as SummaryWriter
from training.agreement import agree_on_options
from training.launch import add_launch_options, viewers
from training.loop import run_training
from training.observers.report import training_report
from training.observers.standard import standard_observers
from training.output_folder import new_folder, own_folder
from training.plan import Plan
from training.run import Run
from utils.general_utils import safe_state
from utils.ranks.ranks import ranks
from utils.system_utils import UserError, mkdir_p, run_cli
from viewing.options import Address
from viewing.server import checked_address

__all__ = ["main", "parse", "prepare_output_and_logger", "training", "training_report"]


def training(
    dataset: argparse.Namespace,
    opt: argparse.Namespace,
    pipe: argparse.Namespace,
    testing_iterations: Sequence[int],
    saving_iterations: Sequence[int],
    checkpoint_iterations: Sequence[int],
    checkpoint: str | None,
    debug_from: int = -1,
    record_curve: bool = True,
    plain_step: bool = False,
    remote_viewer: tuple[str, int] | None = None,
    viewer: Address | None = None,
    parallel: str = "tiles",
) -> None:
    """Train from the options of the three groups; write model, checkpoints and log to dataset.model_path.

    testing_iterations, saving_iterations, checkpoint_iterations: when to score, save the PLY, save a checkpoint.
    checkpoint: a chkpntN.pth to resume, or None. debug_from: switch pipe.debug on after this iteration. plain_step: no
    fast steps. record_curve: with test views, write error_vs_time.csv during training, and draw it. remote_viewer:
    where to listen for it, None: nowhere, unless network_gui listens already. viewer: where the web page listens, None:
    no page. parallel: how several ranks share the work, "tiles" or "views".
    """
    dataset.model_path = dataset.model_path or new_folder()
    print(f"Optimizing {dataset.model_path}")
    iterations = testing_iterations, saving_iterations, checkpoint_iterations
    plan = Plan(*iterations, checkpoint, debug_from, record_curve, plain_step, viewer, parallel)
    run = Run(dataset, opt, pipe, plan)
    # Write nothing before every input check has passed: a mistyped option must not overwrite a finished model.
    with own_folder(dataset.model_path), network_gui.listening(remote_viewer):
        writer = prepare_output_and_logger(dataset, **run.kept) if ranks().first else None
        run.begin()
        run_training(run, standard_observers(run, writer, training_report))


def prepare_output_and_logger(args: argparse.Namespace, **kept: Any) -> Any | None:
    """Make the output folder, args.model_path, with cfg_args and model.json (kept: as write_model_json takes it).

    An empty model_path becomes that of a new folder. Returns a TensorBoard writer, or None without TensorBoard.
    """
    args.model_path = args.model_path or new_folder()
    print(f"Output folder: {args.model_path}")
    mkdir_p(args.model_path)
    write_cfg_args(args.model_path, args)
    write_model_json(args.model_path, args, **kept)
    try:
        return SummaryWriter(args.model_path)
    except ImportError:
        print("TensorBoard is not installed: no event file (pip install tensorboard brings it)")
        return None


def _parser() -> tuple[argparse.ArgumentParser, ModelParams, OptimizationParams, PipelineParams]:
    parser = OptionParser(description="Train a Gaussian model from photos with known cameras.")
    groups = ModelParams(parser), OptimizationParams(parser), PipelineParams(parser)
    add = parser.add_argument
    add_launch_options(parser)
    add("--debug_from", type=int, default=-1, metavar="N", help="switch --debug on after iteration N (default: never)")
    add("--detect_anomaly", action="store_true", help="let autograd name the operation that produced a NaN; slow")
    listed = {"type": int, "nargs": "+", "metavar": "N"}
    add("--test_iterations", **listed, default=[7_000, 30_000],
        help="iterations that score the test views, -1: none (default: 7000 30000, reference)")  # fmt: skip
    add("--save_iterations", **listed, default=[7_000, 30_000],
        help="iterations that save the model besides the last, -1: none (default: 7000 30000, reference)")  # fmt: skip
    add("--checkpoint_iterations", **listed, default=[], help="iterations that save a checkpoint (default: none)")
    add("--start_checkpoint", type=str, default=None, metavar="FILE", help="chkpntN.pth to resume (default: none)")
    add("--no_curve", action="store_true",
        help="write no error_vs_time.csv and .png, which cost up to 5 %% of the time, more in short runs "
        "(default: write them with --eval)")  # fmt: skip
    add("--plain_step", action="store_true",
        help="take every step by autograd, slower and with the same result (default: the fast step)")  # fmt: skip
    add("--quiet", action="store_true", help="print nothing but the progress bar and errors")
    return parser, *groups


def parse(argv: Sequence[str] | None = None) -> tuple[argparse.Namespace, ...]:
    """Parse the command line: all options, and those of the groups model, optimisation and pipeline.

    UserError for a value out of range; argparse ends the program at a word that it does not know.
    """
    parser, *groups = _parser()
    args = parser.parse_args(argv)
    options = [group.extract(args) for group in groups]
    for name in ("test_iterations", "save_iterations", "checkpoint_iterations"):
        if wrong := [t for t in getattr(args, name) if t < 1 and t != -1]:
            raise UserError(f"--{name} takes iterations from 1 on, or -1 for none, got {wrong[0]}")
    return args, *options


def main(argv: Sequence[str] | None = None) -> None:
    """Train as the command line says."""
    args, dataset, opt, pipe = parse(argv)
    safe_state(args.quiet, opt.seed)
    agree_on_options(args)
    torch.autograd.set_detect_anomaly(args.detect_anomaly)
    listening = viewers(args, checked_address(args.viewer_host, args.viewer))
    further = args.debug_from, not args.no_curve, args.plain_step, *listening, args.parallel
    iterations = args.test_iterations, [*args.save_iterations, opt.iterations], args.checkpoint_iterations
    training(dataset, opt, pipe, *iterations, args.start_checkpoint, *further)
    print("Training complete.")


if __name__ == "__main__":
    run_cli(main, several=True)
