"""Decoded pictures of a scene: where they are kept, how many, and which are made ready ahead of their use."""

import os
import sys
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor

from scene.pictures.decode import decode
from scene.pictures.device_copies import DeviceCopies
from utils.host.memory import free_memory
from utils.host.threads import threads

GPU_SHARE = 0.25  # of the memory free at the start: what pictures may take of a GPU; the model needs the rest
COPIES_AHEAD = 2  # pictures copied to the GPU ahead of their use; a copy takes less than an iteration

Size = tuple[int, int]  # width, height


class Decodable(Protocol):
    """A hashable source of pixels that are more than a photo: a mask (masks.py) or a depth map (depth_maps.py).

    pixel_bytes: of what `decode` gives at a size (width, height), (channels,H,W).
    """

    pixel_bytes: int

    def decode(self, size: Size) -> Tensor: ...


Source = Path | Decodable
Picture = tuple[Source, Size]
Key = tuple[str | Decodable, Size]  # files by their names, which are quicker to look up


class ImageStore:
    """Pictures of `decode`, and other sources that have one, each decoded once and kept.

    Beyond `limit` (0: none) the longest unused one is dropped; a mask or a depth map counts as a picture.
    keep_on: device that keeps them. device: that which `get` hands them out on (default: keep_on). Where it is a GPU
    and keep_on is not, they lie in pinned memory and are copied without waiting. Threads exist only while there is
    something to decode ahead. For one calling thread.
    """

    def __init__(
        self, limit: int = 0, keep_on: torch.device | str = "cpu", device: torch.device | str | None = None
    ) -> None:
        self.limit = limit
        self.keep_on = torch.device(keep_on)
        self.device = torch.device(keep_on if device is None else device)
        self._kept: OrderedDict[Key, Tensor | Future[Tensor]] = OrderedDict()  # in order of use
        self._planned: set[Key] = set()
        self._awaited: set[Key] = set()  # planned for training, and not decoded yet
        self._workers = threads()
        self._threads: ThreadPoolExecutor | None = None
        self._copies: DeviceCopies | None = None

    def plan(self, training: Iterable[Picture], others: Iterable[Picture] = ()) -> None:
        """Say which pictures there will be, before the first is asked for.

        Where they do not fit GPU_SHARE of a GPU's free memory, as many as are kept at once, the CPU keeps them. A limit
        that all of them fit is none.
        """
        self._awaited = {_key(source, size) for source, size in training}
        self._planned = self._awaited | {_key(source, size) for source, size in others}
        if self.limit >= len(self._planned):
            self.limit = 0
        if self.keep_on.type == "cuda" and self.planned_bytes > GPU_SHARE * free_memory(self.keep_on):
            self.keep_on = torch.device("cpu")
        if self.device.type == "cuda" and self.keep_on.type == "cpu":
            self._copies = DeviceCopies(self.device)

    @property
    def planned_bytes(self) -> int:
        """Memory that the pictures of `plan` take at most, as many as are kept at once."""
        sizes = sorted((_bytes(*key) for key in self._planned), reverse=True)
        if self._copies:
            sizes = [1 << (size - 1).bit_length() for size in sizes]  # torch pins memory in powers of two
        return sum(sizes[: self.limit or None])

    def get(self, source: Source, size: Size) -> Tensor:
        """Picture (3 or 4,H,W) uint8 of `decode`, or what the source decodes to, on the store's device.

        UserError as `decode`.
        """
        key = _key(source, size)
        picture = self._kept.get(key)
        if picture is None or isinstance(picture, Future):
            picture = self._finished(key)
        self._kept.move_to_end(key)
        return self._copies.take(key, picture) if self._copies else picture.to(self.device, non_blocking=True)

    @property
    def ahead(self) -> int:
        """How many pictures `prefetch` can make use of, the one in use included; 0 when it has nothing to do."""
        if self.limit or self._awaited:
            most = 1 + 2 * self._workers
            return min(self.limit, most) if self.limit else most
        return 1 + COPIES_AHEAD if self._copies else 0

    def prefetch(self, coming: Sequence[Picture]) -> None:
        """Begin to make pictures ready, without waiting: those that `get` is asked for next, in that order.

        At most `limit`. A picture that can't be decoded ends in an error where it is asked for, not here.
        """
        keys = list(dict.fromkeys(_key(source, size) for source, size in coming))[: self.limit or None]
        for key in keys:
            if key in self._kept:
                self._kept.move_to_end(key)
        # Now those that are not coming are in front, and no more are dropped than there are of them.
        for key in keys:
            if key not in self._kept:
                self._make_room()
                self._threads = self._threads or ThreadPoolExecutor(self._workers, thread_name_prefix="decode")
                self._kept[key] = self._threads.submit(self._decode, key)
        if self._copies:
            self._copies.keep_only(keys)
            for key in keys[: 1 + COPIES_AHEAD]:
                picture = self._kept[key]
                if not isinstance(picture, Future):
                    self._copies.send(key, picture)
                elif picture.done() and not picture.exception():
                    self._copies.send(key, self._finished(key))

    def __len__(self) -> int:
        """Pictures that are kept, those being decoded included."""
        return len(self._kept)

    def _finished(self, key: Key) -> Tensor:
        """Keep a picture that a thread decodes or has decoded, or that is decoded here; it is moved to `keep_on`."""
        future = self._kept.pop(key, None)
        if future is None:
            self._make_room()
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
        # Copies to a GPU wait for nothing only from pinned memory.
        return picture.pin_memory() if "cuda" in (self.keep_on.type, self.device.type) else picture

    def _make_room(self) -> None:
        while self.limit and len(self._kept) >= self.limit:
            _, oldest = self._kept.popitem(last=False)
            if isinstance(oldest, Future) and not oldest.cancel():
                wait([oldest])  # a thread is at it, and holds as much memory as a picture kept


def _key(source: Source, size: Size) -> Key:
    return os.fspath(source) if isinstance(source, Path) else source, size


def _bytes(source: str | Decodable, size: Size) -> int:
    """Bytes of a decoded picture at most: a JPEG has no alpha, of others it is not known before they are decoded."""
    if not isinstance(source, str):
        return source.pixel_bytes * size[0] * size[1]
    channels = 3 if source.lower().endswith((".jpg", ".jpeg")) else 4
    return channels * size[0] * size[1]


def picture_device(data_device: str, fallback: torch.device) -> torch.device:
    """Device that keeps the pictures: option --data_device where it can be used, else the device that computes.

    A line says so where that is another than the option names, but for plain cuda where no GPU computes.
    """
    try:
        wanted = torch.device(data_device)
    except RuntimeError:
        wanted = None
    if wanted is None or wanted.type not in ("cpu", "cuda"):
        reason = "is neither cpu nor cuda"
    elif wanted.type == "cpu" or (fallback.type == "cuda" and (wanted.index or 0) < torch.cuda.device_count()):
        return wanted
    elif wanted.index is None:
        return fallback
    else:
        reason = "is not there, or not used"
    print(f"warning: --data_device {data_device} {reason}; pictures are kept on {fallback}", file=sys.stderr)
    return fallback
