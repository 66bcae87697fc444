"""Options of train.py besides the three groups: when to score and save, where to begin."""

import argparse
from typing import Any

from splatting.parts import options_of


# fmt: off
def add_launch_options(parser: argparse.ArgumentParser) -> None:
    """Add them to a parser. Iterations are those of the schedule (splatting/training/schedule)."""
    add = parser.add_argument
    flag, listed = {"action": "store_true"}, {"type": int, "nargs": "+", "metavar": "N"}
    add("--debug_from", type=int, default=-1, metavar="N", help="switch --debug on after iteration N (default: never)")
    add("--detect_anomaly", **flag, help="let autograd name the operation that produced a NaN; slow")
    add("--test_iterations", **listed, default=[7_000, 30_000],
        help="iterations that score the test views, -1: none (default: 7000 30000, reference)")
    add("--save_iterations", **listed, default=[7_000, 30_000],
        help="iterations that save the model besides the last, -1: none (default: 7000 30000, reference)")
    add("--checkpoint_iterations", **listed, default=[], help="iterations that save a checkpoint (default: none)")
    add("--start_checkpoint", type=str, metavar="FILE", help="chkpntN.pth to resume (default: none)")
    for option in options_of("launch"):
        option.add_to(parser, sentinel=False)
    add("--plain_step", **flag,
        help="take every step by autograd, slower and with the same result (default: the fast step)")
    add("--advise", **flag, help="print which options the scene's photos, poses and points ask for, and end; with -m "
             "also write advice.json there")
    add("--options", choices=["given", "auto"], default="given",
        help="auto: take what --advise says, besides the options that are given (default: given)")
    add("--quiet", **flag, help="print nothing but the progress bar and errors")
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
