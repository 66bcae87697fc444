"""Bytes that a call takes from torch's allocator, whether or not it gives them back."""

from collections.abc import Callable

import torch
from torch.profiler import ProfilerActivity, profile


def allocated_bytes(run: Callable[[], object], device: torch.device) -> int:
    """Sum all allocations of one call, after a warm-up call. On a GPU they include the kernels' scratch memory."""
    run()
    if device.type == "cuda":
        before = torch.cuda.memory_stats(device)["requested_bytes.all.allocated"]
        run()
        return torch.cuda.memory_stats(device)["requested_bytes.all.allocated"] - before
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as trace:
        run()
    events = trace.profiler.kineto_results.events()
    return sum(max(event.nbytes(), 0) for event in events if event.name() == "[memory]")
