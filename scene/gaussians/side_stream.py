"""A stream of its own for copies between a GPU and its host, beside the steps."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor


class SideStream:
    """Runs copies beside the current stream of a GPU; on the CPU at once."""

    def __init__(self) -> None:
        self._stream: torch.cuda.Stream | None = None

    @contextmanager
    def aside(self, *used: Tensor) -> Iterator[Callable[[Tensor], Tensor]]:
        """Queue what is done here behind the work so far, and let the current stream go on.

        used: tensors that it reads. Yields what a new tensor goes through that the current stream shall use.
        """
        if not used[0].is_cuda:
            yield lambda made: made
            return
        here = torch.cuda.current_stream(used[0].device)
        self._stream = self._stream or torch.cuda.Stream(used[0].device)
        self._stream.wait_stream(here)
        for tensor in used:
            tensor.record_stream(self._stream)

        def keep(made: Tensor) -> Tensor:
            made.record_stream(here)
            return made

        with torch.cuda.stream(self._stream):
            yield keep

    def join(self) -> None:
        """Let the current stream wait for all that was queued here."""
        if self._stream is not None:
            torch.cuda.current_stream(self._stream.device).wait_stream(self._stream)
