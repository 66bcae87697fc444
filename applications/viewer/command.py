"""Show a trained model on a web page that this process serves.

python view.py -m MODEL [--iteration N] [--port PORT]
python view.py -s SCENE                                 # cameras, photos and points, before a training
python view.py FILE                                     # a model of any tool, without a scene
"""

from __future__ import annotations

import groundwork.host.openmp  # noqa: F401  isort: skip  (before torch)

import argparse
import os

from torch import Tensor

from applications.viewer.page import Page, serve
from applications.viewer.server import check_port
from applications.viewer.untrained import load_untrained
from arguments import ModelParams, OptionParser, PipelineParams, get_combined_args, warn_of_background
from gaussian_renderer.camera_paths.without_scene import WithoutScene, circle_cameras, saved_scene, warn_if_moved
from groundwork.applications import VIEWER_PORT, application
from scene.gaussians.morton import sort_scattered
from scene.scene import Scene
from scene.splats.reading import READABLE
from scene.splats.splats import drawable, selected
from scene.with_splats import model_of, splats_in
from utils.general_utils import safe_state
from utils.system_utils import UserError


def load_file(path: str, pipeline: argparse.Namespace) -> WithoutScene:
    """Load the model of a file, seen from a circle around it. `pipeline` gets antialiasing if the file says so."""
    splats = application("export", "reading").read_any(path) if path.lower().endswith(".sog") else splats_in(path)
    splats = selected(splats, drawable(splats))
    pipeline.antialiasing = pipeline.antialiasing or splats.antialiasing
    folder, name = os.path.split(os.path.abspath(path))
    gaussians = model_of(splats)
    sort_scattered(gaussians)
    return WithoutScene(gaussians, folder, name, circle_cameras(splats.means))


def load_folder(options: argparse.Namespace, args: argparse.Namespace) -> Scene | WithoutScene:
    """Load the model of a folder with its scene, or with the poses that the folder records if the scene is gone."""
    scene = saved_scene(options, args.iteration, args.typed_sh_degree)
    warn_if_moved(options.model_path, scene.getTrainCameras())
    return scene


def find_kept(
    scene: Scene | WithoutScene, args: argparse.Namespace, pipe: argparse.Namespace, options: argparse.Namespace
) -> Tensor | None:
    """Return a mask (N,) of the Gaussians that --clean leaves, None without it. UserError where photos are gone."""
    if not args.clean:
        return None
    if isinstance(scene, WithoutScene):
        raise UserError(f"--clean needs the photos of {options.source_path}, which is gone; leave it out")
    return application("export", "cleaning").clean_scene(scene, args.clean, pipe, options.white_background)[0].keep


def main() -> None:
    """Show the model or the scene that the command line names, until the page is closed."""
    parser = OptionParser(description="Show a trained model on a web page, until Ctrl-C.")
    model_params = ModelParams(parser, sentinel=True)
    pipeline_params = PipelineParams(parser, sentinel=True)
    parser.add_argument("--iteration", type=int, default=-1, help="saved iteration to show (default: -1, the last)")
    parser.add_argument(
        "--port", type=int, default=VIEWER_PORT, help=f"port of the page, 0: any (default: {VIEWER_PORT})"
    )
    help_text = "let the tab View show what export.py --clean leaves out (default: off; 0.05 without a number)"
    parser.add_argument("--clean", type=float, nargs="?", const=0.05, metavar="DB", help=help_text)
    parser.add_argument("--quiet", action="store_true", help="print nothing to stdout (default: off)")
    parser.add_argument(
        "file",
        nargs="?",
        default="",
        metavar="FILE",
        help=f"model in place of -m: {READABLE}, or .sog through splat-transform",
    )
    args = parser.parse_args()
    if args.file and args.model_path:
        raise UserError(f"-m {args.model_path} has a model of its own; leave {args.file} or -m out")
    if args.clean is not None:
        application("export", "cleaning").check_clean(args.clean)
    if args.clean and not args.model_path:
        raise UserError("--clean needs training views of a model; give the model's folder with -m")
    before = bool(args.source_path) and not (args.file or args.model_path)
    if not (args.file or before or args.model_path):
        raise UserError("no model given; pass a model folder by -m, a file of a model alone, or a scene by -s")
    args = args if args.file or before else get_combined_args(parser)
    options, pipeline = model_params.extract(args), pipeline_params.extract(args)
    check_port(args.port)
    safe_state(args.quiet)
    if args.file:
        scene = load_file(args.file, pipeline)
    elif before:
        scene = load_untrained(options)
    else:
        warn_of_background(options)
        scene = load_folder(options, args)
    if len(scene.gaussians) == 0:
        raise UserError(f"{scene.loaded_iter} of {scene.model_path} has no Gaussians; choose another model")
    oriented = options.source_path if os.path.isdir(options.source_path or "") else ""
    shown = find_kept(scene, args, pipeline, options), before, None if args.file else oriented
    page = Page(args.port, scene, pipeline, options.white_background, scene.halves, *shown)
    try:
        raise serve(page)
    finally:
        page.stop()
