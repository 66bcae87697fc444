"""The store of decoded images: it decodes each once, within a limit, ahead of use, and does not change training."""

import gc
import threading
import time
import weakref
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from waiting import wait_for

from scene.images.decode import decode
from scene.images.store import ImageStore
from utils.system_utils import UserError

SIZE = (6, 4)


@pytest.fixture
def files(tmp_path) -> list[Path]:
    """Ten photos of 6x4 pixels, each of another colour."""
    paths = [tmp_path / f"{number}.png" for number in range(10)]
    for number, path in enumerate(paths):
        Image.new("RGB", SIZE, (20 * number, 10, 0)).save(path)
    return paths


class Decodings:
    """Counters of the calls of `decode` by file, and a watch on the images in memory at once.

    limit: most of them, 0: any number. exceeded: whether there have been more. A thread that has decoded an image may
    hold it for a moment after another one has dropped it, so that such a moment is waited for; no decoding ends
    meanwhile.
    """

    def __init__(self) -> None:
        self.names: list[str] = []
        self.alive = self.limit = 0
        self.exceeded = False
        self.threads: set[str] = set()
        self.seconds = 0.0
        self._begins, self._counts = threading.Lock(), threading.RLock()

    def __call__(self, path, size):
        with self._begins:
            self._count(1)
            self.names.append(path.stem)
            self.threads.add(threading.current_thread().name)
            try:
                wait_for(lambda: self.exceeded or not self.limit or self.alive <= self.limit)
            except TimeoutError:
                self.exceeded = True
        time.sleep(self.seconds)
        try:
            with self._begins:
                picture = decode(path, size)
        except BaseException:
            self._count(-1)
            raise
        weakref.finalize(picture, self._count, -1)
        return picture

    def _count(self, more: int) -> None:
        with self._counts:
            self.alive += more


@pytest.fixture
def decodings(monkeypatch) -> Decodings:
    counting = Decodings()
    monkeypatch.setattr("scene.images.store.decode", counting)
    return counting


def _pictures(paths: list[Path]) -> list[tuple[Path, tuple[int, int]]]:
    return [(path, SIZE) for path in paths]


@pytest.mark.parametrize(("limit", "decoded"), [(0, 3), (2, 4), (1, 6)])
def test_each_is_decoded_once_within_the_limit(files, decodings, limit, decoded):
    store = ImageStore(limit)
    for name in (0, 1, 0, 2, 0, 1):  # with room for two: 2 replaces 1, since 0 was used later
        store.get(files[name], SIZE)
        assert not limit or len(store) <= limit
    assert len(decodings.names) == decoded


@pytest.mark.parametrize("workers", [1, 4])
@pytest.mark.parametrize("limit", [0, 1, 2, 3, 9])
def test_decoding_ahead_gives_the_right_pictures_within_the_limit(files, decodings, limit, workers):
    store = ImageStore(limit)
    store._workers = workers
    decodings.seconds, decodings.limit = 0.002, limit
    store.plan(_pictures(files))
    order = np.random.default_rng(0)
    order = [int(i) for _ in range(4) for i in order.permutation(len(files))]
    for step, number in enumerate(order):
        store.prefetch(_pictures([files[i] for i in order[step : step + store.ahead]]))
        picture = store.get(files[number], SIZE)
        assert picture[0, 0, 0] == 20 * number and picture.shape == (3, 4, 6)
        del picture
        if step % 7 == 0:  # scoring asks for views that were not prefetched
            assert store.get(files[step % 10], SIZE)[0, 0, 0] == 20 * (step % 10)
        assert not limit or len(store) <= limit
    gc.collect()
    if limit:
        assert not decodings.exceeded
    else:
        assert sorted(decodings.names) == [path.stem for path in files]
    if limit != 1:
        assert any(name.startswith("decode") for name in decodings.threads)


def test_what_comes_next_is_decoded_meanwhile(files, decodings):
    store = ImageStore(3)
    store._workers = 2
    store.plan(_pictures(files))
    store.prefetch(_pictures(files[:3]))
    wait_for(lambda: len(decodings.names) >= 3)
    assert sorted(decodings.names) == ["0", "1", "2"]
    for path in files[:3]:
        store.get(path, SIZE)
    assert len(decodings.names) == 3 and threading.current_thread().name not in decodings.threads


def test_an_error_ahead_comes_at_the_view_that_needs_it(files):
    store = ImageStore(4)
    files[2].write_bytes(files[2].read_bytes()[:40])
    store.plan(_pictures(files))
    store.prefetch(_pictures(files[:4]))
    for number in (0, 1, 3):
        assert store.get(files[number], SIZE)[0, 0, 0] == 20 * number
    for _ in range(2):
        with pytest.raises(UserError, match="cannot read .*2.png"):
            store.get(files[2], SIZE)
    store.prefetch(_pictures(files[1:4]))
    with pytest.raises(UserError, match="cannot read .*2.png"):
        store.get(files[2], SIZE)
    Image.new("RGB", SIZE, (40, 0, 0)).save(files[2])
    assert store.get(files[2], SIZE)[0, 0, 0] == 40


def test_a_limit_that_all_fit_is_none(files):
    store = ImageStore(10)
    store.plan(_pictures(files[:8]), _pictures(files[8:]))
    assert store.limit == 0
    store = ImageStore(9)
    store.plan(_pictures(files[:8]), _pictures(files[8:]))
    assert store.limit == 9 and store.planned_bytes == 9 * 4 * 6 * 4


def test_a_gpu_keeps_what_fits_its_share(files, monkeypatch):
    """The rule alone: which device keeps, without one."""
    free = 4 * 10 * 4 * 6 * 4  # four times what ten RGBA pictures take
    monkeypatch.setattr("scene.images.store.free_memory", lambda device: free)
    monkeypatch.setattr("scene.images.store.DeviceCopies", lambda device: object())
    for room, limit, kept in ((0, 0, "cuda"), (-1, 0, "cpu"), (-1, 9, "cuda"), (-2 * 4 * 96, 8, "cuda")):
        free = 3840 + room
        store = ImageStore(limit, "cuda", "cuda")
        store.plan(_pictures(files[:7]), _pictures(files[7:]))
        assert store.keep_on.type == kept, (room, limit)
    assert store.planned_bytes == 8 * 96
    store = ImageStore(0, "cpu", "cuda")
    store.plan(_pictures(files))
    assert store.keep_on.type == "cpu" and store.planned_bytes == 10 * 128  # pinned in powers of two


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no NVIDIA GPU")
@pytest.mark.parametrize("limit", [0, 3])
@pytest.mark.parametrize("keep_on", ["cuda", "cpu"])
def test_pictures_reach_the_gpu_whole(tmp_path, limit, keep_on):
    """Images so large that a copy takes a while, read at once by kernels on the current stream."""
    rng = np.random.default_rng(0)
    size = (1024, 768)
    paths = [tmp_path / f"{number}.bmp" for number in range(8)]
    for path in paths:
        Image.fromarray(rng.integers(0, 256, (*size[::-1], 3), dtype=np.uint8)).save(path)
    truth = {path: decode(path, size).long().sum().item() for path in paths}
    store = ImageStore(limit, keep_on, "cuda")
    store.plan([(path, size) for path in paths])
    order = [paths[i] for _ in range(12) for i in rng.permutation(len(paths))]
    sums = []
    for step, path in enumerate(order):
        store.prefetch([(coming, size) for coming in order[step : step + store.ahead]])
        picture = store.get(path, size)
        assert picture.is_cuda
        sums.append(picture.long().sum())
        del picture
        assert not limit or len(store) <= limit
    assert [int(value) for value in sums] == [truth[path] for path in order]
