"""A saved model, loaded with its scene.

The SH degree is read from the PLY, not from cfg_args, because --prune_sh changes the last save alone.
"""

import argparse

from scene.gaussian_model import GaussianModel
from scene.gaussians.ply import stored_sh_degree
from scene.saved_iterations import find_iteration, saved_ply
from scene.scene import Scene


def load_saved(options: argparse.Namespace, iteration: int, sh_degree: int | None = None) -> Scene:
    """Scene of the model options, whose `gaussians` are those of a saved iteration, -1: the last one.

    sh_degree: degree that the PLY must have, None: any. UserError as from Scene and GaussianModel.load_ply.
    """
    iteration = find_iteration(options.model_path, iteration)
    if sh_degree is None:
        sh_degree = stored_sh_degree(saved_ply(options.model_path, iteration))
    gaussians = GaussianModel(options.sh_degree if sh_degree is None else sh_degree)
    return Scene(options, gaussians, load_iteration=iteration, shuffle=False)
