"""Decoded images of a scene: decoded ahead of their use, and kept in the memory of the CPU or the GPU."""

import os
import sys
from collections import OrderedDict
from collections.abc import Callable, Collection, Hashable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from groundwork.host.machine import threads
from groundwork.host.memory import free_memory
from groundwork.ranks.ranks import ALONE, Ranks
from groundwork.ranks.shared_images import SharedImage, share_images
from scene.images.decode import decode

GPU_SHARE = 0.25  # of a GPU's free memory at the start that images may take; the model needs the rest
COPIES_AHEAD = 2  # images copied to the GPU ahead of their use; a copy takes less than an iteration

Size = tuple[int, int]  # width, height


class Decodable(Protocol):
    """A hashable source of pixels other than a photo: a mask (masks.py) or a depth map (depth_maps.py).

    pixel_bytes: bytes per pixel of the tensor (channels,H,W) that `decode` gives at a size (width, height).
    """

    pixel_bytes: int

    def decode(self, size: Size) -> Tensor: ...


@dataclass(frozen=True, eq=False)
class InMemory:
    """An image that was given as pixels at training size, and needs no decoding.

    A photo (3,H,W), or (4,H,W) with alpha: uint8 with straight alpha, as `scene.images.decode.decode` gives it, or
    float in [0,1] with colours that are multiplied by alpha already. A depth map: (1,H,W) float32.
    """

    pixels: Tensor

    def transformed(self, change: Callable[[Tensor], Tensor]) -> "InMemory":
        """Make another image of this one, now."""
        return InMemory(change(self.pixels))

    def __deepcopy__(self, memo: dict) -> "InMemory":
        return self  # never changed in place, so that copies of a camera can share it


def has_pixels(source: Any) -> bool:
    """Tell whether an image has its pixels, in memory or shared by processes, so that no store is needed."""
    return hasattr(source, "pixels")


Source = Path | Decodable
Picture = tuple[Source, Size]
Key = tuple[str | Decodable, Size]  # files by name, which is faster to hash than a Path


class ImageStore:
    """Images of photos and other sources, each decoded once and kept.

    limit: most images kept, 0: all; beyond it the least recently used one is dropped. A mask or a depth map counts as
    an image. keep_on: device that keeps them. device: where `get` returns them (default: keep_on). If only `device`
    is a GPU, images lie in pinned memory and are copied without waiting. Threads exist only while there is something to
    decode ahead. Call all methods from one thread.

    ranks: processes that have the same `plan`. Each decodes and keeps a part of it, and gives an image of it to the
    others whenever it is read: all have to read the same images in the same order. The limit counts for each.
    """

    def __init__(
        self,
        limit: int = 0,
        keep_on: torch.device | str = "cpu",
        device: torch.device | str | None = None,
        ranks: Ranks = ALONE,
    ) -> None:
        """Make an empty store. The arguments are those of the class."""
        self.limit = limit
        self.ranks = ranks
        self.keep_on = torch.device(keep_on)
        self.device = torch.device(keep_on if device is None else device)
        self._kept: OrderedDict[Key, Tensor | Future[Tensor]] = OrderedDict()  # in order of use
        self._planned: set[Key] = set()
        self._awaited: set[Key] = set()  # planned for training, and not decoded yet
        self._shared: dict[Key, SharedImage] = {}
        self._workers = threads()
        self._floats_fit = True
        self._threads: ThreadPoolExecutor | None = None
        self._copies: DeviceCopies | None = None

    def plan(self, training: Iterable[Picture], others: Iterable[Picture] = ()) -> None:
        """Announce all images, before the first is asked for.

        If the images kept at once exceed GPU_SHARE of a GPU's free memory, the CPU keeps them. A limit that all images
        fit into is dropped.
        """
        training = dict.fromkeys(_make_key(source, size) for source, size in training)
        keys = dict.fromkeys([*training, *(_make_key(source, size) for source, size in others)])
        self._planned = set(keys)
        if self.ranks.several:
            sizes = {key: _count_bytes(*key) for key in keys}
            self._planned, self._shared = share_images(sizes, self._get_own, self.device, self.ranks)
        self._awaited = self._planned & training.keys()
        if self.limit >= len(self._planned):
            self.limit = 0
        if self.keep_on.type == "cuda":
            free = free_memory(self.keep_on)
            self._floats_fit = 4 * self.planned_bytes <= GPU_SHARE * free
            if self.planned_bytes > GPU_SHARE * free:
                self.keep_on = torch.device("cpu")
        if self.device.type == "cuda" and self.keep_on.type == "cpu":
            self._copies = DeviceCopies(self.device)

    @property
    def planned(self) -> int:
        """Number of the images of `plan` that this process decodes."""
        return len(self._planned)

    @property
    def planned_bytes(self) -> int:
        """Upper bound on the bytes of the images of `plan` that this process keeps at once."""
        sizes = sorted((_count_bytes(*key) for key in self._planned), reverse=True)
        if self._copies:
            sizes = [1 << (size - 1).bit_length() for size in sizes]  # torch pins memory in powers of two
        return sum(sizes[: self.limit or None])

    @property
    def keeps_floats(self) -> bool:
        """True if images may also be kept as float32, four times as large, on the device of --data_device."""
        return not self.limit and self._floats_fit and not self.ranks.several

    def get(self, source: Source, size: Size) -> Tensor:
        """Image (3 or 4,H,W) uint8 of a photo, or the tensor that another source decodes to, on the store's device.

        UserError as `decode`.
        """
        key = _make_key(source, size)
        return self._shared[key].pixels if key in self._shared else self._get_own(key)

    def transformed(self, source: Source, size: Size, change: Callable[[Tensor], Tensor]) -> InMemory:
        """Make an image of another one, which the store does not keep: now, or in one process for all that share it."""
        shared = self._shared.get(_make_key(source, size))
        return InMemory(change(self.get(source, size))) if shared is None else shared.transformed(change)

    def _get_own(self, key: Key) -> Tensor:
        """Return this process's own image of a key on the device, decoded now if it is not kept."""
        picture = self._kept.get(key)
        if picture is None or isinstance(picture, Future):
            picture = self._finish(key)
        self._kept.move_to_end(key)
        return self._copies.take(key, picture) if self._copies else picture.to(self.device, non_blocking=True)

    @property
    def ahead(self) -> int:
        """Number of images that `prefetch` can use, the current one included; 0 when it has nothing to do.

        Those of other processes count as well, though it leaves them out.
        """
        count = 1 + COPIES_AHEAD if self._copies else 0
        if self.limit or self._awaited:
            most = 1 + 2 * self._workers
            count = min(self.limit, most) if self.limit else most
        return count * self.ranks.size

    def prefetch(self, coming: Sequence[Picture]) -> None:
        """Start to prepare the images that `get` is asked for next, in that order and at most `limit`; never waits.

        An image that cannot be decoded raises its error in `get`.
        """
        keys = dict.fromkeys(_make_key(source, size) for source, size in coming)
        keys = [key for key in keys if key not in self._shared or key in self._planned][: self.limit or None]
        for key in keys:
            if key in self._kept:
                self._kept.move_to_end(key)
        # The other images are now in front. They are dropped first, and there are enough of them.
        for key in keys:
            if key not in self._kept:
                self._drop_oldest()
                self._threads = self._threads or ThreadPoolExecutor(self._workers, thread_name_prefix="decode")
                self._kept[key] = self._threads.submit(self._decode, key)
        if self._copies:
            self._copies.keep_only(keys)
            for key in keys[: 1 + COPIES_AHEAD]:
                picture = self._kept[key]
                if not isinstance(picture, Future):
                    self._copies.send(key, picture)
                elif picture.done() and not picture.exception():
                    self._copies.send(key, self._finish(key))

    def __len__(self) -> int:
        """Number of images that are kept, those being decoded included."""
        return len(self._kept)

    def _finish(self, key: Key) -> Tensor:
        """Wait for the thread that decodes an image, or decode it here if none does; keep it on `keep_on`."""
        future = self._kept.pop(key, None)
        if future is None:
            self._drop_oldest()
        picture = future.result() if future else self._decode(key)
        self._kept[key] = picture = picture.to(self.keep_on, non_blocking=True)
        self._awaited.discard(key)
        if self._threads and not self._awaited and not self.limit:
            self._threads.shutdown(wait=False)
            self._threads = None
        return picture

    def _decode(self, key: Key) -> Tensor:
        source, size = key
        picture = decode(Path(source), size) if isinstance(source, str) else source.decode(size)
        # Only copies from pinned memory to a GPU are asynchronous.
        return picture.pin_memory() if "cuda" in (self.keep_on.type, self.device.type) else picture

    def _drop_oldest(self) -> None:
        while self.limit and len(self._kept) >= self.limit:
            _, oldest = self._kept.popitem(last=False)
            if isinstance(oldest, Future) and not oldest.cancel():
                wait([oldest])  # a thread is decoding it, and holds as much memory as a kept image


class DeviceCopies:
    """Copies on a stream of their own: they wait for no kernel, and kernels wait only for the image they need."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._stream = torch.cuda.Stream(device)
        self._sent: dict[Hashable, tuple[Tensor, torch.cuda.Event]] = {}

    def send(self, key: Hashable, image: Tensor) -> None:
        """Start to copy a pinned image, unless its copy was started before."""
        if key in self._sent:
            return
        with torch.cuda.stream(self._stream):
            copy = image.to(self._device, non_blocking=True)
            ready = torch.cuda.Event()
            ready.record(self._stream)
        self._sent[key] = copy, ready

    def take(self, key: Hashable, image: Tensor) -> Tensor:
        """The copy, for use on the current stream. The stream waits for it, the host does not."""
        self.send(key, image)
        copy, ready = self._sent.pop(key)
        current = torch.cuda.current_stream(self._device)
        current.wait_event(ready)
        copy.record_stream(current)  # keeps its memory until that stream is done with it
        return copy

    def keep_only(self, keys: Collection[Hashable]) -> None:
        """Drop the untaken copies of all other keys."""
        for key in self._sent.keys() - set(keys):
            del self._sent[key]


def _make_key(source: Source, size: Size) -> Key:
    return os.fspath(source) if isinstance(source, Path) else source, size


def _count_bytes(source: str | Decodable, size: Size) -> int:
    """Most bytes of a decoded image: a JPEG has no alpha; other files may have some, which only decoding shows."""
    if not isinstance(source, str):
        return source.pixel_bytes * size[0] * size[1]
    channels = 3 if source.lower().endswith((".jpg", ".jpeg")) else 4
    return channels * size[0] * size[1]


def image_device(data_device: str, fallback: torch.device, warn: bool = False) -> torch.device:
    """Device that keeps the images: that of the option --data_device if it can be used, else the one that computes.

    warn: say so when the option is not followed, except for plain `cuda` when no GPU computes.
    """
    try:
        requested = torch.device(data_device)
    except RuntimeError:
        requested = None
    fault = None
    if requested is None or requested.type not in ("cpu", "cuda"):
        fault = "is neither cpu nor cuda"
    elif requested.type == "cpu" or (fallback.type == "cuda" and (requested.index or 0) < torch.cuda.device_count()):
        return requested
    elif requested.index is not None:
        fault = "is not available"
    if fault and warn:
        print(f"warning: --data_device {data_device} {fault}; photos are kept on {fallback}", file=sys.stderr)
    return fallback
