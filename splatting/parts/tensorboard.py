"""Losses and scores as events for TensorBoard, where the package is installed."""

import sys
from collections.abc import Callable
from functools import partial
from io import BytesIO
from typing import TYPE_CHECKING, Any

from splatting.part import Part
from splatting.training import events

if TYPE_CHECKING:
    import argparse

    from torch import Tensor

    from splatting.training.iteration import Iteration, Losses

_FLUSHED = 10  # seconds until events are in the file at the latest


class Tensorboard(Part):
    """Writes the losses of every tenth iteration, but for testing ones: there `training_report` writes all."""

    name = "tensorboard"

    @classmethod
    def wanted(cls, given: "argparse.Namespace") -> bool:
        return True

    def opened(self, run: Any) -> None:
        from splatting.training.scores import training_report

        self._run = run
        self._writes = run.writer is not None and run.report is training_report
        self._kept: list[tuple] = []
        if run.writer is not None:
            run.resources.callback(run.writer.close)

    def measured(self, at: "Iteration", losses: "Losses") -> None:
        if not self._writes:
            return
        if at.iteration % events.INTERVAL == 0 and not at.takes(self._run.launch.test_iterations):
            self._kept.append((at.iteration, losses.l1, losses.total, self._run.clock.seconds - at.started))
        if at.due and self._kept:
            with self._run.clock.paused("scoring"):
                self._write()

    def _write(self) -> None:
        """Write what is kept. The GPU is waited for once, and not once for each loss."""
        import torch

        kept, self._kept = self._kept, []
        values = torch.stack([loss.detach() for _, *pair, _ in kept for loss in pair]).cpu().view(-1, 2)
        for (iteration, *_, seconds), (l1, total) in zip(kept, values, strict=True):
            events.Events(self._run.writer, iteration).losses(l1, total, seconds)


class EventWriter:
    """A SummaryWriter of torch, all of whose methods can be called. ImportError without TensorBoard.

    If one fails, as on a full disk, one warning says so, and nothing more is written.
    """

    def __init__(self, log_dir: str) -> None:
        from torch.utils.tensorboard import SummaryWriter  # takes 0.3 s to import

        self._folder, self._failed = log_dir, False
        self._writer = self._guarded(SummaryWriter, log_dir, flush_secs=_FLUSHED)

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("_"):
            raise AttributeError(name)
        return partial(self._guarded, getattr(self._writer, name, None))

    def add_image(self, tag: str, image: "Tensor", global_step: int) -> None:
        """Add an image (3, H, W), from 0 to 1, as a JPEG: a training took 8 s for PNGs and their checksums."""
        self._guarded(self._add_jpeg, tag, image, global_step)

    def _add_jpeg(self, tag: str, image: "Tensor", step: int) -> None:
        from PIL import Image
        from tensorboard.compat.proto.summary_pb2 import Summary

        from splatting.files.image_files import to_bytes

        jpeg, pixels = BytesIO(), to_bytes(image).numpy()
        Image.fromarray(pixels).save(jpeg, "JPEG", quality=90)
        height, width, _ = pixels.shape
        picture = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=jpeg.getvalue())
        self._writer.file_writer.add_summary(Summary(value=[Summary.Value(tag=tag, image=picture)]), step)

    def _guarded(self, method: Callable[..., Any], *given: Any, **named: Any) -> Any:
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
    """A SummaryWriter of torch; None without TensorBoard."""
    try:
        return EventWriter(folder)
    except ImportError:
        return None  # doctor.py says so
