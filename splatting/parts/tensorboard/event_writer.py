"""TensorBoard's writer of event files, without which a training goes on."""

import sys
from collections.abc import Callable
from functools import partial
from io import BytesIO
from typing import Any

from PIL import Image
from torch import Tensor
from tqdm import tqdm

from splatting.files.image_files import to_bytes

_FLUSHED = 10  # seconds until events are in the file at the latest


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

    def add_image(self, tag: str, image: Tensor, global_step: int) -> None:
        """Add an image (3, H, W), from 0 to 1, as a JPEG: a training took 8 s for PNGs and their checksums."""
        self._guarded(self._add_jpeg, tag, image, global_step)

    def _add_jpeg(self, tag: str, image: Tensor, step: int) -> None:
        from tensorboard.compat.proto.summary_pb2 import Summary

        jpeg, pixels = BytesIO(), to_bytes(image).numpy()
        Image.fromarray(pixels).save(jpeg, "JPEG", quality=90)
        height, width, _ = pixels.shape
        picture = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=jpeg.getvalue())
        self._writer.file_writer.add_summary(Summary(value=[Summary.Value(tag=tag, image=picture)]), step)

    def _guarded(self, method: Callable[..., Any], *given: Any, **named: Any) -> Any:
        if self._failed:
            return None
        try:
            return method(*given, **named)
        except Exception as error:  # whatever it is, the training goes on
            self._failed = True
            fault = f"cannot write TensorBoard's events into {self._folder} ({error})"
            tqdm.write(f"warning: {fault}; training continues without them", file=sys.stderr)
            return None
