"""The last save of a training: the finished model without what it does not need."""

import argparse
import dataclasses
import math

from arguments import add_to_model_json, write_cfg_args
from gaussian_renderer.scored_views import ScoredViews
from gaussian_renderer.trimming import change_on_views, trim
from splatting.training.left_out import LeftOut
from splatting.training.run import Run


def save_last(run: Run, scored: bool, iteration: int) -> LeftOut:
    """Save the finished model without what it does not need, and record in model.json what was left out.

    scored: whether to compute the change in PSNR, which is cheap if the test photos are in memory. iteration: the last.
    """
    scene, trained, opt, halves = run.scene, run.scene.gaussians, run.opt, run.dataset.train_test_exp
    trained.optimizer.zero_grad(set_to_none=True)  # room for the trimmed copy
    trimmed = trim(trained, scene.getTrainCameras(), run.pipe, opt.keep_unseen, opt.prune_sh, iteration)
    final, test = trimmed.gaussians, scene.getTestCameras()
    change = {}
    if test and (trimmed.unseen > trimmed.search.faint or trimmed.cut_bounds[final.max_sh_degree] > 0):
        change = change_on_views(trained, final, test, ScoredViews(run.pipe, run.background, halves), scored)
    scene.save(iteration, final)
    write_cfg_args(scene.model_path, argparse.Namespace(**vars(run.dataset) | {"sh_degree": final.max_sh_degree}))
    kept_pixels, file_pixels = scene.training_pixels()
    left_out = LeftOut(
        gaussians=trained.total,
        unseen=trimmed.unseen,
        faint=trimmed.search.faint,
        keep_unseen=opt.keep_unseen,
        search=trimmed.search.end,
        views=trimmed.search.views,
        iterations=iteration,
        max_sh_degree=trained.max_sh_degree,
        sh_degree=final.max_sh_degree,
        cut_bounds=trimmed.cut_bounds,
        ply_bytes=trained.ply_bytes,
        ply_bytes_saved=trained.ply_bytes - final.ply_bytes,
        seconds=round(trimmed.seconds, 3),
        picture_bytes=3 * kept_pixels,
        picture_bytes_in_files=3 * file_pixels,
        test_change={name: value for name, value in change.items() if math.isfinite(value)},
    )
    add_to_model_json(scene.model_path, left_out=dataclasses.asdict(left_out))
    return left_out
