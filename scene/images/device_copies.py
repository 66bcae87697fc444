"""Copies of pinned images to a GPU, made while it computes."""

from collections.abc import Collection, Hashable

import torch
from torch import Tensor


class DeviceCopies:
    """Copies on a stream of their own: they wait for no kernel, and kernels wait only for the image they need."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._stream = torch.cuda.Stream(device)
        self._sent: dict[Hashable, tuple[Tensor, torch.cuda.Event]] = {}

    def send(self, key: Hashable, picture: Tensor) -> None:
        """Start to copy a pinned image, unless its copy was started before."""
        if key in self._sent:
            return
        with torch.cuda.stream(self._stream):
            copy = picture.to(self._device, non_blocking=True)
            ready = torch.cuda.Event()
            ready.record(self._stream)
        self._sent[key] = copy, ready

    def take(self, key: Hashable, picture: Tensor) -> Tensor:
        """The copy, for use on the current stream. The stream waits for it, the host does not."""
        self.send(key, picture)
        copy, ready = self._sent.pop(key)
        current = torch.cuda.current_stream(self._device)
        current.wait_event(ready)
        copy.record_stream(current)  # keeps its memory until that stream is done with it
        return copy

    def keep_only(self, keys: Collection[Hashable]) -> None:
        """Drop the untaken copies of all other keys."""
        for key in self._sent.keys() - set(keys):
            del self._sent[key]
