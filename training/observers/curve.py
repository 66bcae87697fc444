"""The recorder of a training's curve of error against run time."""

import argparse
from collections.abc import Sequence

from torch import Tensor

from gaussian_renderer.scored_views import ScoredViews
from records.curve_recorder import CurveRecorder, evenly_spread
from records.error_curve import Row
from records.training_log import TrainingLog
from scene import Scene


def scene_curve(
    scene: Scene,
    rows: list[Row],
    log: TrainingLog,
    iterations: int,
    testing_iterations: Sequence[int],
    pipe: argparse.Namespace,
    background: Tensor,
    train_test_exp: bool,
) -> CurveRecorder | None:
    """Recorder of the error of all test views and as many training views; None for a scene without test views."""
    test = scene.getTestCameras()
    if not test:
        return None
    trained = [camera for camera in scene.getTrainCameras() if camera.columns is None]  # in whole
    scored = ScoredViews(pipe, background, train_test_exp)
    return CurveRecorder(
        scene.model_path,
        rows,
        log,
        iterations,
        testing_iterations,
        {"test": test, "train": evenly_spread(trained, len(test))},
        lambda camera: scored.image(camera, scene.gaussians),
        scored.target,
        scored.mask,
        background.device,
    )
