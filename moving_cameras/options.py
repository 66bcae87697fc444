"""Options of render.py for a camera path.

moving_cameras/request.py, which is loaded only for a path, checks their values: it imports SciPy, which takes a while.
"""

import argparse

from utils.system_utils import UserError

_WITH_PATH = ("fps", "size", "seconds", "frames")
_WITHOUT_PATH = ("depth", "alpha")


def add_path_options(parser: argparse.ArgumentParser) -> None:
    """Add them to a parser."""
    group = parser.add_argument_group("Camera path")
    kinds = "interpolate, ellipse, spiral, or a JSON file of keyframes"
    group.add_argument("--path", metavar="PATH", help=f"write a video along {kinds}, and no views (default: none)")
    group.add_argument("--fps", type=int, metavar="N", help="frames a second (default: 30)")
    size = "width and height, even (default: that of the first training camera, made even)"
    group.add_argument("--size", type=int, nargs=2, metavar=("W", "H"), help=size)
    group.add_argument("--seconds", type=float, metavar="S", help="of a path that is no file (default: 10)")
    group.add_argument("--frames", action="store_true", help="write each frame as PNG, too (default: off)")


def wants_path(args: argparse.Namespace) -> bool:
    """Whether --path was given. UserError for options that do not go with it, or with its lack."""
    for name in _WITHOUT_PATH if args.path is not None else _WITH_PATH:
        if getattr(args, name) not in (None, False):
            kind, remedy = ("the train and test views", "or --path") if args.path else ("a path", "or pass --path, too")
            raise UserError(f"--{name} is for {kind}; leave it out, {remedy}")
    return args.path is not None
