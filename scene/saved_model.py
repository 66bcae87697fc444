"""A saved model with its scene.

Its PLY, not cfg_args, says of which SH degree it is: --prune_sh cuts the last save alone.
"""

import argparse

from scene.gaussian_model import GaussianModel
from scene.gaussians.ply import stored_sh_degree
from scene.saved_iterations import find_iteration, saved_ply
from scene.scene import Scene


def load_saved(options: argparse.Namespace, iteration: int, sh_degree: int | None = None) -> Scene:
    """The views of the model options, and in `gaussians` what options.model_path has of an iteration, -1: the last.

    sh_degree: that which the PLY must have, None: any. UserError as Scene and GaussianModel.load_ply.
    """
    iteration = find_iteration(options.model_path, iteration)
    if sh_degree is None:
        sh_degree = stored_sh_degree(saved_ply(options.model_path, iteration))
    gaussians = GaussianModel(options.sh_degree if sh_degree is None else sh_degree)
    return Scene(options, gaussians, load_iteration=iteration, shuffle=False)
