"""What a training says of itself on the way: TensorBoard's scalars and pictures, scores in testing iterations."""

import sys
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from scene import Scene
from utils.image_utils import as_float, pixels_that_count, psnr, right_half

LOG_INTERVAL = 10  # iterations between TensorBoard's losses: reading one waits for the GPU


def training_report(
    tb_writer: Any | None,
    iteration: int,
    l1: Tensor,
    loss: Tensor,
    l1_loss: Callable[[Tensor, Tensor], Tensor],
    elapsed: float,
    testing_iterations: Sequence[int],
    scene: Scene,
    renderFunc: Callable[..., dict[str, Tensor]],
    renderArgs: tuple,
    train_test_exp: bool = False,
) -> dict[str, float]:
    """Log every tenth iteration to TensorBoard; in a testing one score test views and five training views, and print.

    elapsed: seconds of this iteration; renderArgs: what follows camera and model in renderFunc, (pipe, background).
    train_test_exp: render with exposures, and score right halves only.
    Returns `<set>_l1` and `<set>_psnr` (dB, mean over views and channels) of the sets scored, {} otherwise.
    """
    if tb_writer and iteration % LOG_INTERVAL == 0:
        tb_writer.add_scalar("train_loss_patches/l1_loss", l1.item(), iteration)
        tb_writer.add_scalar("train_loss_patches/total_loss", loss.item(), iteration)
        tb_writer.add_scalar("iter_time", elapsed * 1000.0, iteration)
    if iteration not in testing_iterations:
        return {}
    exposed = {"use_trained_exp": True} if train_test_exp else {}
    train = scene.getTrainCameras()
    sets = {"test": scene.getTestCameras(), "train": [train[i % len(train)] for i in range(5, 30, 5)]}
    scores = {}
    for name, cameras in sets.items():
        if not cameras:
            continue
        differences, ratios = [], []
        for index, camera in enumerate(cameras):
            with torch.no_grad():
                image = renderFunc(camera, scene.gaussians, *renderArgs, **exposed)["render"]
                target = as_float(camera.target(renderArgs[1]))
                mask = camera.mask
                if train_test_exp:
                    image, target, mask = (None if x is None else right_half(x) for x in (image, target, mask))
                if mask is not None and not mask.any():
                    continue
                counted = [pixels_that_count(x, mask) for x in (image, target)]
                differences.append(l1_loss(*counted).item())
                ratios.append(psnr(*counted).mean().item())
            if tb_writer and index < 5:
                tag = f"{name}_view_{camera.image_name}"
                tb_writer.add_image(f"{tag}/render", image, global_step=iteration)
                if iteration == testing_iterations[0]:
                    tb_writer.add_image(f"{tag}/ground_truth", target, global_step=iteration)
        if not ratios:
            continue
        l1_mean, psnr_mean = sum(differences) / len(differences), sum(ratios) / len(ratios)
        tqdm.write(f"[ITER {iteration}] Evaluating {name}: L1 {l1_mean} PSNR {psnr_mean}", file=sys.stdout)
        if tb_writer:
            tb_writer.add_scalar(f"{name}/loss_viewpoint - l1_loss", l1_mean, iteration)
            tb_writer.add_scalar(f"{name}/loss_viewpoint - psnr", psnr_mean, iteration)
        scores |= {f"{name}_l1": l1_mean, f"{name}_psnr": psnr_mean}
    if tb_writer:
        tb_writer.add_histogram("scene/opacity_histogram", scene.gaussians.get_opacity, iteration)
        tb_writer.add_scalar("total_points", len(scene.gaussians), iteration)
    return scores
