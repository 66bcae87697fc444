"""Look at the environment, a dataset and a trained model, and say in one line each what is wrong and what to do.

python doctor.py [-s SCENE] [-m MODEL]

Exit status: 0 all is well, 1 there are problems, 2 it could not look.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from diagnosis import environment
from diagnosis.lines import Line


def diagnose(source: str | None, images: str, model: str | None, iteration: int) -> int:
    """Print the lines of all checks that were asked for; number of problems. source, model: None for none."""
    lines = environment.check_packages()
    complete = not any(line.finding for line in lines)
    if complete:
        import utils.host.openmp  # noqa: F401  isort: skip  (before torch)

        lines += environment.check_build()
        complete = environment.extensions_load()
    problems = _show("environment", lines)
    if not complete:
        print("dataset and model are not looked at, since that needs the packages")
        return problems
    from utils.system_utils import UserError

    for option, folder in (("-s", source), ("-m", model)):
        if folder is not None and not (folder and Path(folder).is_dir()):
            raise UserError(f"no folder {folder or repr(folder)}; give an existing one with {option}")
    if source is not None:
        from diagnosis.dataset import check_dataset

        problems += _show(f"dataset {source}", check_dataset(source, images))
    if model is not None:
        from diagnosis.model import check_model

        problems += _show(f"model {model}", check_model(model, iteration))
    return problems


def _show(title: str, lines: list[Line]) -> int:
    print(f"{title}:")
    for line in lines:
        print(f"  {line}")
    return sum(line.finding for line in lines)


def main(argv: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description="Say what is wrong with environment, dataset and model, and what to do."
    )
    add = parser.add_argument
    add("-s", "--source_path", default=None, metavar="SCENE", help="scene folder to look at (default: none)")
    add("-m", "--model_path", default=None, metavar="MODEL", help="model folder to look at (default: none)")
    add("-i", "--images", default="images", help="folder of the pictures under the scene folder (default: images)")
    add("--iteration", type=int, default=-1, help="saved iteration of the model (default: the last)")
    args = parser.parse_args(argv)
    problems = diagnose(args.source_path, args.images, args.model_path, args.iteration)
    if problems:
        print(f"{problems} problem{'s' if problems > 1 else ''}")
        sys.exit(1)
    print("all is well")


if __name__ == "__main__":
    try:
        from utils.system_utils import run_cli
    except ImportError:  # for want of torch, which is what main says
        main()
    else:
        run_cli(main)
