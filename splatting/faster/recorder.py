"""The recorder: captures the launches of a function as a CUDA graph, with what torch needs for that."""

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import torch
from torch import Tensor


class Recorder:
    """Captures graphs on a stream of its own, on which nothing ever runs. All graphs share one pool of memory."""

    def __init__(self, device: torch.device) -> None:
        self._device, self._stream = device, torch.cuda.Stream(device)
        self._keeper: torch.cuda.CUDAGraph | None = None

    def capture(self, body: Callable[[], Tensor]) -> tuple[Callable[[], None], Tensor]:
        """Capture the launches of a function. Return a function that launches them again, and the result of `body`.

        Each launch overwrites the result. RuntimeError, torch.OutOfMemoryError among them, if the function cannot be
        captured.
        """
        if self._keeper is None:
            self._pool, self._word = torch.cuda.graph_pool_handle(), torch.zeros(1, device=self._device)
            # Torch gives the pool's memory back once no graph uses it; the next capture would wait for it.
            self._keeper, _ = self._record(self._word.zero_)
        graph, result = self._record(body)
        return graph.replay, result

    def release(self) -> None:
        """Give back the memory of graphs that nobody uses any more, and the memory that torch keeps for later."""
        self._keeper = None
        torch.cuda.empty_cache()

    def is_tight(self) -> bool:
        """Tell whether torch has taken most of what it may take, and should give back what it keeps for later."""
        free, total = torch.cuda.mem_get_info(self._device)
        most = torch.cuda.get_per_process_memory_fraction() * total
        return min(free, most - torch.cuda.memory_reserved(self._device)) < most / 4

    def _record(self, body: Callable[[], Tensor]) -> tuple[torch.cuda.CUDAGraph, Tensor]:
        """Capture the launches of a function on the recorder's stream. Return the graph, and the function's result."""
        self._stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._stream), _no_collection():
            # capture_begin allocates two words for the random generator. Where that fails, torch's destructor of the
            # graph throws, which aborts the process. Here it fails before there is a graph.
            words = [torch.empty(1, dtype=torch.int64, device=self._device) for _ in range(2)]
            del words  # to the cache of this stream, which the next allocations take
            graph = torch.cuda.CUDAGraph()
            graph.capture_begin(pool=self._pool, capture_error_mode="thread_local")
            try:
                result = body()
                graph.capture_end()
            except BaseException:
                self._end(graph)
                raise
        return graph, result

    def _end(self, graph: torch.cuda.CUDAGraph) -> None:
        """End a capture that has failed, so that torch's allocator and generator leave it."""
        index = torch.cuda.current_device()
        try:
            graph.capture_end()
        except RuntimeError:  # which tells of the capture, not of its cause, and ends nothing else
            with suppress(RuntimeError):
                # Within a capture, torch gives no memory back to the driver.
                torch._C._cuda_endAllocateToPool(index, self._pool)
                torch._C._cuda_releasePool(index, self._pool)
        # Where the body has ended the capture, torch's generator would go on as in one, and fail.
        generator = torch.cuda.default_generators[index]
        generator.graphsafe_set_state(generator.clone_state())


@contextmanager
def _no_collection() -> Iterator[None]:
    """Turn Python's garbage collection off: to destroy the graph of an earlier training would invalidate a capture."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
