"""The parser of train.py, and its options besides the three groups: when to score and save, where to begin."""

import argparse
from typing import Any

from arguments import ModelParams, OptimizationParams, PipelineParams, TopicParser
from arguments.features import options_of
from arguments.option import MOST_NEEDED
from arguments.param_group import OptionTable


def training_parser() -> tuple[TopicParser, tuple[OptionTable, ...]]:
    """The parser of train.py, with its groups of options: model, optimisation and pipeline."""
    about = "Train a Gaussian model from photos with known cameras."
    parser = TopicParser(usage="%(prog)s -s SCENE -m MODEL [options]", description=about)
    groups = ModelParams(parser), OptimizationParams(parser), PipelineParams(parser)
    add_launch_options(parser)
    return parser, groups


# fmt: off
def add_launch_options(parser: argparse.ArgumentParser) -> None:
    """Add them to a parser. Iterations are those of the schedule (splatting/schedule)."""
    flag, listed = {"action": "store_true"}, {"type": int, "nargs": "+", "metavar": "N"}

    def add(name: str, topic: str, **more: Any) -> None:
        parser.add_argument(name, **more).topic = topic  # type: ignore[attr-defined]

    add("--debug_from", "debugging", type=int, default=-1, metavar="N",
        help="switch --debug on after iteration N (default: never)")
    add("--detect_anomaly", "debugging", **flag,
        help="let autograd name the operation that produced a NaN; slow (default: off)")
    add("--test_iterations", "output", **listed, default=[7_000, 30_000],
        help="iterations that score the test views, -1: none (default: 7000 30000, reference)")
    add("--save_iterations", "output", **listed, default=[7_000, 30_000],
        help="iterations that save the model besides the last, -1: none (default: 7000 30000, reference)")
    add("--checkpoint_iterations", "output", **listed, default=[],
        help="iterations that save a checkpoint (default: none)")
    add("--start_checkpoint", MOST_NEEDED, type=str, metavar="FILE",
        help="checkpoint to resume, a chkpntN.pth (default: none)")
    for option in options_of("launch"):
        option.add_to(parser, sentinel=False)
    add("--plain_step", "debugging", **flag,
        help="take every step by autograd, slower and with the same result (default: off)")
    add("--advise", "data", **flag,
        help="print the options that this scene's photos, poses and points call for, and exit; with -m also write "
             "advice.json there (default: off)")
    add("--options", MOST_NEEDED, choices=["given", "auto"], default="given",
        help="auto: add the options that --advise prints to those you give (default: given)")
    add("--quiet", "output", **flag, help="print nothing but the progress bar and errors (default: off)")
# fmt: on


def launch_options(**given: Any) -> argparse.Namespace:
    """These options without a command line: those given by name, and the defaults of the others.

    TypeError for other names.
    """
    parser = argparse.ArgumentParser()
    add_launch_options(parser)
    called = {option.name: option.called for option in options_of("launch") if option.called is not None}
    defaults = vars(parser.parse_args([])) | called
    if unknown := sorted(given.keys() - defaults.keys()):
        raise TypeError(f"train.py has no option --{unknown[0]}")
    return argparse.Namespace(**defaults | given)
