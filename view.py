"""Show a trained model on a web page that this process serves.

python view.py -m MODEL [--iteration N] [--port PORT]
"""

from __future__ import annotations

if __name__ == "__main__":
    import splatting.host.early  # noqa: F401  (before the other imports, which take a second)

import splatting.host.openmp  # noqa: F401  isort: skip  (before torch)

from arguments import ModelParams, OptionParser, PipelineParams, get_combined_args, warn_of_background
from scene.saved_model import load_saved
from splatting.viewer.page import Page, serve
from splatting.viewer.server import HOST_OPTION, PORT, checked_address
from utils.general_utils import safe_state
from utils.system_utils import UserError, run_cli


def main() -> None:
    parser = OptionParser(description="Show a trained model on a web page, until Ctrl-C.")
    model_params = ModelParams(parser, sentinel=True)
    pipeline_params = PipelineParams(parser, sentinel=True)
    parser.add_argument("--iteration", type=int, default=-1, help="saved iteration to show (default: -1, the last)")
    parser.add_argument("--port", type=int, default=PORT, help=f"port of the page, 0: any (default: {PORT})")
    HOST_OPTION.add_to(parser, sentinel=False)
    parser.add_argument("--quiet", action="store_true", help="print nothing to stdout (default: off)")
    args = get_combined_args(parser)
    options, pipeline = model_params.extract(args), pipeline_params.extract(args)
    place = checked_address(args.viewer_host, args.port)
    safe_state(args.quiet)
    warn_of_background(options)
    scene = load_saved(options, args.iteration, args.typed_sh_degree)
    if len(scene.gaussians) == 0:
        raise UserError(f"iteration {scene.loaded_iter} of {scene.model_path} has no Gaussians; train it again")
    page = Page(place, scene, pipeline, options.white_background, scene.halves)
    try:
        raise serve(page)
    finally:
        page.stop()


if __name__ == "__main__":
    run_cli(main)
