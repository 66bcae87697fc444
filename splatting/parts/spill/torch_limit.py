"""The limit of what torch takes of a GPU, while a training lasts."""

import torch

CAN_SPILL = tuple(map(int, torch.__version__.split(".")[:2])) >= (2, 11)  # csrc/torch/spilled.cpp
_before: list[float] = []  # the share of the GPU that torch might take before it got a limit; empty without one


def limit_torch(limit: float, device: torch.device) -> None:
    """Leave torch so many bytes of the GPU; `free_memory` then counts no others.

    Its segments then grow and shrink, as lists that change their size would leave holes of a fifth of the limit.
    """
    if not _before:
        _before.append(torch.cuda.get_per_process_memory_fraction())
    if CAN_SPILL:
        torch._C._accelerator_setAllocatorSettings("expandable_segments:True")
    if torch.cuda.memory_reserved(device) > limit:
        torch.cuda.empty_cache()
    total = torch.cuda.get_device_properties(device).total_memory
    torch.cuda.set_per_process_memory_fraction(min(max(limit / total, 0.0), 1.0))


def release_torch() -> None:
    """Let torch take what it might before."""
    while _before:
        torch.cuda.set_per_process_memory_fraction(_before.pop())
