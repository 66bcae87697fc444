"""Cases of hostile files of torch.save: mutated pickles of sound ones, and crafted ones."""

import io
import pickletools
import random
import struct
import zipfile
from pathlib import Path

import numpy as np
import torch
from gaussians import model, take_steps

from fuzz.crafted_pickles import CRAFTED, SECRET, archive
from fuzz.damage import damaged
from groundwork.files.tensor_files import read_tensors
from scene.gaussians.checkpoint import load_checkpoint
from utils.system_utils import UserError

_PLAIN = (type(None), bool, int, float, str, torch.Tensor, torch.nn.Parameter)


class Hostile:
    """Both doors for such files: a sentence that shows nothing of the file, or plain values."""

    most, seconds = 200 << 20, 6.0  # bytes and processor's seconds of a case; a busy machine needs three times as many

    def __init__(self, folder: Path) -> None:
        self._path = folder / "hostile.pth"

    def load(self, content: bytes) -> None:
        self._path.write_bytes(content)
        for door in (lambda: read_tensors(self._path, legacy=True), lambda: load_checkpoint(self._path)):
            try:
                _check(door())
            except (ValueError, UserError) as error:
                message = str(error)
                assert SECRET not in message and message.isprintable(), f"shows the file: {message!r}"


class Mutated(Hostile):
    """The pickle of a checkpoint, ours or the reference's, or of weights, with some bytes or operations changed."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        gaussians = model(5, 1)
        take_steps(gaussians, 2)
        capture = list(gaussians.capture())
        capture[10]["state"][0]["exp_avg"] = capture[10]["state"][0]["exp_avg"].T
        theirs = [*capture[:11], np.float64(2.5)]
        theirs[1:7] = [torch.nn.Parameter(value.detach()) for value in theirs[1:7]]
        layer = torch.nn.Conv2d(3, 4, 3)
        self._sound = [_saved(content) for content in ((capture, 12), (theirs, 12), layer.state_dict())]
        self._legacy = _saved(layer.state_dict(), _use_new_zipfile_serialization=False)

    def run(self, rng: random.Random) -> None:
        if rng.randrange(4) == 0:
            self.load(_mutated(rng, self._legacy))
            return
        with zipfile.ZipFile(io.BytesIO(rng.choice(self._sound))) as sound:
            parts = {name.partition("/")[2]: sound.read(name) for name in sound.namelist()}
        self.load(archive(parts | {"data.pkl": _mutated(rng, parts["data.pkl"])}))


class Crafted(Hostile):
    """A file that was written to take memory, time or control."""

    def run(self, rng: random.Random) -> None:
        self.load(CRAFTED[rng.choice(sorted(CRAFTED))](rng))


def _saved(content: object, **options: object) -> bytes:
    file = io.BytesIO()
    torch.save(content, file, **options)
    return file.getvalue()


def _mutated(rng: random.Random, whole: bytes) -> bytes:
    """A pickle, or a file that begins with one, with one to five changes of bytes, operations or numbers."""
    if rng.random() < 0.3:
        return damaged(rng, whole)
    places = [place for _, _, place in pickletools.genops(whole)]
    if whole[places[-1] + 1 :]:  # of the old format, whose fourth pickle has the content
        for _ in range(3):
            start = places[-1] + 1
            places += [start + place for _, _, place in pickletools.genops(whole[start:])]
    ends = [*places[1:], places[-1] + 1]
    operations = [whole[start:end] for start, end in zip(places, ends, strict=True)]
    rest = whole[ends[-1] :]
    for _ in range(rng.randint(1, 5)):
        place, other = rng.randrange(len(operations)), rng.randrange(len(operations))
        kind = rng.choice(("drop", "double", "swap", "copy", "number", "code"))
        if kind == "drop":
            operations[place] = b""
        elif kind == "double":
            operations[place] *= rng.choice((2, 3, 300))
        elif kind == "swap":
            operations[place], operations[other] = operations[other], operations[place]
        elif kind == "copy":
            operations[place] = operations[other]
        elif kind == "number":
            number = rng.choice((-1, 0, 1, 7, 2**31 - 1, -(2**31), rng.randrange(2**31)))
            operations[place] = b"J" + struct.pack("<i", number)
        else:
            operations[place] = rng.randbytes(1) + operations[place][1:]
    return b"".join(operations) + rest


def _check(content: object) -> None:
    """Every part has a plain type, and every value of a tensor can be read."""
    left = [content]
    while left:
        part = left.pop()
        if type(part) is dict:
            left += [*part.keys(), *part.values()]
        elif type(part) in (list, tuple):
            left += part
        else:
            assert type(part) in _PLAIN, type(part)
            if isinstance(part, torch.Tensor):
                part.detach().clone()
