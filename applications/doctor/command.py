"""Check the environment, a dataset and a trained model; print each problem and its remedy in one line.

python doctor.py [-s SCENE] [-m MODEL]

Exit status: 0 no problems, 1 problems, 2 the checks could not run.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from applications.doctor import environment
from arguments import OptionParser
from groundwork.finding import Finding
from groundwork.host.listing import counted


def diagnose(source: str | None, images: str | None, model: str | None, iteration: int, masks: str = "") -> int:
    """Print the lines of the checks and return the number of problems.

    source, model: folders to check, or None. With both, the model is checked against that scene. images: folder of the
    photos, None: `images`, and for a model the one that it was trained on. masks: of the source, as train.py's --masks.
    """
    lines = environment.check_packages()
    complete = not any(one.is_problem for one in lines)
    if complete:
        import groundwork.host.openmp  # noqa: F401  isort: skip  (before torch)

        lines += environment.check_build()
        complete = environment.can_load_extensions()
    problems = _show("environment", lines)
    if not complete:
        print("dataset and model were not checked, because packages are missing")
        return problems
    from utils.system_utils import UserError

    for option, folder in (("-s", source), ("-m", model)):
        if folder is not None and not (folder and Path(folder).is_dir()):
            if option == "-m" and source is not None and not Path(folder).exists():
                print(f"no model in {folder} yet: it is not checked")
                model = None
                continue
            raise UserError(f"no folder {folder or repr(folder)}; pass an existing folder as {option}")
    if masks and source is None:
        raise UserError("--masks names mask files of a scene; give the scene as -s, or leave --masks out")
    if source is not None:
        from applications.doctor.advice import check_options
        from scene.checks.scene import check_dataset
        from scene.images.masks import MaskOptions

        names = source, images or "images"
        found = [*check_dataset(*names, MaskOptions(masks)), *check_options(*names, model, masks)]
        problems += _show(f"dataset {source}", found)
    if model is not None:
        from applications.doctor.model import check_model

        problems += _show(f"model {model}", check_model(model, iteration, source, images))
    return problems


def _show(title: str, found: list[Finding]) -> int:
    print(f"{title}:")
    for one in found:
        print(f"  {one.line}")
    return sum(one.is_problem for one in found)


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = OptionParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("-s", "--source_path", default=None, metavar="SCENE",
        help="scene folder to check; with -m the model is compared with it (default: none)")  # fmt: skip
    add("-m", "--model_path", default=None, metavar="MODEL",
        help="model folder to check, without -s with the scene that it was trained on (default: none)")  # fmt: skip
    add("-i", "--images", default=None,
        help="folder of the photos inside the scene folder (default: images, or that of the model)")  # fmt: skip
    add("--masks", default="", metavar="FOLDER",
        help="mask files of SCENE, as for train.py; a model has its own (default: those that SCENE names)")  # fmt: skip
    add("--iteration", type=int, default=-1, help="saved iteration of the model (default: the last)")
    args = parser.parse_args(argv)
    problems = diagnose(args.source_path, args.images, args.model_path, args.iteration, args.masks)
    if problems:
        print(counted(problems, "problem"))
        sys.exit(1)
    print("no problems found: ready")


def run() -> None:
    """Run `main`. Where torch is missing, which it reports, nothing can catch errors."""
    try:
        import torch  # noqa: F401  (here, where Ctrl-C ends the program at once)

        from utils.system_utils import run_cli
    except ImportError:
        main()
    else:
        run_cli(main)
