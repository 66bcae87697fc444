"""Events of a training for TensorBoard, with the tags of the reference."""

import math
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from io import BytesIO
from typing import Any

import torch
from torch import Tensor

from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from splatting.iteration import Iteration, Losses
from splatting.part import Part

INTERVAL = 10  # iterations between losses: reading one waits for the GPU
_FLUSHED = 10  # seconds until events are in the file at the latest


class Events:
    """Writer of one iteration's events, by a SummaryWriter."""

    def __init__(self, writer: Any, iteration: int) -> None:
        self._writer = writer
        self._iteration = iteration

    def losses(self, l1: Tensor, total: Tensor, seconds: float) -> None:
        """Write the losses of every tenth iteration, and the seconds that the iteration took."""
        if self._iteration % INTERVAL == 0:
            self._scalar("train_loss_patches/l1_loss", l1.item())
            self._scalar("train_loss_patches/total_loss", total.item())
            self._scalar("iter_time", seconds * 1000.0)

    def image(self, views: str, camera: Camera, what: str, image: Tensor) -> None:
        """Write an image (3, H, W) of a view.

        views: name of the view's set.
        """
        self._writer.add_image(f"{views}_view_{camera.image_name}/{what}", image, global_step=self._iteration)

    def scores(self, views: str, means: Mapping[str, float]) -> None:
        """Write the mean scores of a set of views: l1 and psnr."""
        for kind, value in means.items():
            self._scalar(f"{views}/loss_viewpoint - {kind.replace('l1', 'l1_loss')}", value)

    def model(self, gaussians: GaussianModel) -> None:
        """Write a model's opacities, and its number of Gaussians."""
        self._writer.add_histogram("scene/opacity_histogram", gaussians.get_opacity, self._iteration)
        self._scalar("total_points", len(gaussians))

    def _scalar(self, tag: str, value: float) -> None:
        self._writer.add_scalar(tag, value, self._iteration)


class LossEvents(Part):
    """Writes the losses of every tenth iteration, except testing ones, in which `training_report` writes them."""

    def __init__(self, run: Any) -> None:
        self._run = run
        self._kept: list[tuple] = []
        self._written = -math.inf  # when

    def measured(self, at: Iteration, losses: Losses) -> None:
        """Keep the losses of every tenth iteration, and write them now and then in one that is due."""
        if at.iteration % INTERVAL == 0 and not at.takes(self._run.launch.test_iterations):
            self._kept.append((at.iteration, losses.l1, losses.total, self._run.clock.seconds - at.started))
        # Seldom: to stop the clock reads the energy of the GPUs twice, which takes up to 10 ms.
        if at.due and (at.last or time.monotonic() - self._written >= _FLUSHED):
            self._write()

    def stepped(self, at: Iteration) -> None:
        """Write what is kept if a signal ends the training."""
        if at.stopping:
            self._write()

    def _write(self) -> None:
        """Write the losses that are kept, and wait for the GPU once, not once for each loss."""
        if not self._kept:
            return
        with self._run.clock.paused("scoring"):
            kept, self._kept = self._kept, []
            values = torch.stack([loss.detach() for _, *pair, _ in kept for loss in pair]).cpu().view(-1, 2)
            for (iteration, *_, seconds), (l1, total) in zip(kept, values, strict=True):
                Events(self._run.writer, iteration).losses(l1, total, seconds)
            self._written = time.monotonic()


class EventWriter:
    """A SummaryWriter of torch that never ends a training. ImportError without TensorBoard.

    All methods of SummaryWriter can be called. If one fails, as on a full disk, a warning says so, and nothing more is
    written.
    """

    def __init__(self, log_dir: str) -> None:
        from torch.utils.tensorboard import SummaryWriter  # takes 0.3 s to import

        self._folder, self._failed = log_dir, False
        self._writer = self._call_safely(SummaryWriter, log_dir, flush_secs=_FLUSHED)

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("_"):
            raise AttributeError(name)
        return partial(self._call_safely, getattr(self._writer, name, None))

    def add_image(self, tag: str, image: Tensor, global_step: int) -> None:
        """Add an image (3, H, W), from 0 to 1, as a JPEG: a training took 8 s for PNGs and their checksums."""
        self._call_safely(self._add_jpeg, tag, image, global_step)

    def _add_jpeg(self, tag: str, image: Tensor, step: int) -> None:
        """Add an image (3, H, W), from 0 to 1, to the file of events as a JPEG."""
        from PIL import Image
        from tensorboard.compat.proto.summary_pb2 import Summary

        from groundwork.files.image_files import to_bytes

        jpeg, pixels = BytesIO(), to_bytes(image).numpy()
        Image.fromarray(pixels).save(jpeg, "JPEG", quality=90)
        height, width, _ = pixels.shape
        picture = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=jpeg.getvalue())
        self._writer.file_writer.add_summary(Summary(value=[Summary.Value(tag=tag, image=picture)]), step)

    def _call_safely(self, method: Callable[..., Any], *given: Any, **named: Any) -> Any:
        """Call a method of the writer. The first failure becomes a warning; after it, calls do nothing."""
        from tqdm import tqdm

        if self._failed:
            return None
        try:
            return method(*given, **named)
        except Exception as error:  # whatever it is, the training goes on
            self._failed = True
            fault = f"cannot write TensorBoard's events into {self._folder} ({error})"
            tqdm.write(f"warning: {fault}; training continues without them", file=sys.stderr)
            return None


def summary_writer(folder: str) -> Any | None:
    """Return a SummaryWriter of torch; None without TensorBoard."""
    try:
        return EventWriter(folder)
    except ImportError:
        return None  # doctor.py says so
