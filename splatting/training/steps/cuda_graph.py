"""Work that is recorded once, as a CUDA graph, and then queued by one launch."""

from collections.abc import Callable
from contextlib import suppress

import torch
from torch import Tensor


class Recorder:
    """Records on a stream of its own, on which nothing ever runs. All records share one pool of memory."""

    def __init__(self, device: torch.device) -> None:
        self._device, self._stream = device, torch.cuda.Stream(device)
        self._keeper: torch.cuda.CUDAGraph | None = None

    def record(self, body: Callable[[], Tensor]) -> tuple[Callable[[], None], Tensor]:
        """Record what a function queues: a function that queues it, and the result, which each launch overwrites.

        RuntimeError, torch.OutOfMemoryError among them, if it cannot be recorded.
        """
        if self._keeper is None:
            self._pool, self._word = torch.cuda.graph_pool_handle(), torch.zeros(1, device=self._device)
            # Torch gives the pool's memory back once no graph uses it; the next record would wait for it.
            self._keeper, _ = self._graph_of(self._word.zero_)
        graph, result = self._graph_of(body)
        return graph.replay, result

    def release(self) -> None:
        """Give back the memory of records that nobody has any more, and what torch keeps for later."""
        self._keeper = None
        torch.cuda.empty_cache()

    def is_tight(self) -> bool:
        """Whether most of the GPU's memory is taken, so that what is kept for later should be given back."""
        free, total = torch.cuda.mem_get_info(self._device)
        return free < total / 4

    def _graph_of(self, body: Callable[[], Tensor]) -> tuple[torch.cuda.CUDAGraph, Tensor]:
        graph = torch.cuda.CUDAGraph()
        self._stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._stream):
            graph.capture_begin(pool=self._pool, capture_error_mode="thread_local")
            try:
                result = body()
            except BaseException:
                with suppress(RuntimeError):  # which tells of the record, not of its cause
                    graph.capture_end()
                raise
            graph.capture_end()
        return graph, result
