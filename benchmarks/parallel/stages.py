"""Marks around functions of training: where the time of a step goes, and what each part of it sends."""

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import torch
from diff_gaussian_rasterization.backend import OPERATORS
from torch import Tensor

from gaussian_renderer import view_step
from gaussian_renderer.over_ranks import band, exchange, views
from gaussian_renderer.over_ranks.bands import KnownBands
from scene.gaussian_model import GaussianModel
from training.steps.fused import FusedStep
from training.steps.views import ViewsStep
from utils.ranks.ranks import Ranks

REST = "rest"
STAGES = {
    "project": [(OPERATORS, "project")],
    "agree on bands": [(band, "find_bands"), (KnownBands, "find")],
    "numbers of splats": [(exchange, "agree_on_sizes")],
    "splats to bands": [(band, "send_splats")],
    "splats to views": [(views, "send_views")],
    "bin": [(OPERATORS, "bin")],
    "blend": [(OPERATORS, "blend")],
    "project, bin, blend": [(OPERATORS, "rasterize")],
    "rows of the image": [(view_step, "surroundings"), (view_step, "whole_image")],
    "loss": [(FusedStep, "measure"), (ViewsStep, "backward")],
    "backward of blend": [(OPERATORS, "blend_rows")],
    "rows back": [(band, "return_rows"), (views, "return_sums")],
    "backward of projection": [(OPERATORS, "rows_vjp"), (OPERATORS, "rows_vjp_add_")],
    "Adam": [(GaussianModel, "step")],
    "backward of projection, Adam": [(OPERATORS, "rows_vjp_step_")],
    "backward, Adam": [(OPERATORS, "rasterize_vjp_step_")],
    REST: [],
}


class Stages:
    """Milliseconds and bytes by stage; a stage inside another one does not count for that one.

    On a GPU, a stage ends when its kernels do, and so has the time in which the GPU waits for the host or for a rank.
    """

    def __init__(self, device: torch.device) -> None:
        self._by_gpu = device.type == "cuda"
        self._running = [REST]
        self._marks: list[tuple[str, Any]] = []
        self.bytes: dict[str, int] = defaultdict(int)  # sent to other ranks

    def mark(self) -> None:
        """End an interval, which counts for the running stage."""
        if self._by_gpu:
            now = torch.cuda.Event(enable_timing=True)
            now.record()
        else:
            now = time.perf_counter()
        self._marks.append((self._running[-1], now))

    @contextmanager
    def watching(self, ranks: Ranks) -> Iterator[None]:
        """Within it, the stages are marked, and what `ranks` sends is counted."""
        with ExitStack() as patches:
            for stage, places in STAGES.items():
                for owner, name in places:
                    patches.enter_context(patch.object(owner, name, self._around(stage, getattr(owner, name))))
            if ranks.several:
                for name, sent in (("send", _sent), ("agree", _copies), ("table", _copies), ("added", _ring)):
                    patches.enter_context(patch.object(ranks, name, self._counting(ranks, name, sent)))
            self.mark()
            yield

    def milliseconds(self) -> dict[str, float]:
        """The sum of each stage."""
        if self._by_gpu:
            torch.cuda.synchronize()
        total: dict[str, float] = defaultdict(float)
        for (_, begin), (stage, end) in zip(self._marks, self._marks[1:], strict=False):
            total[stage] += begin.elapsed_time(end) if self._by_gpu else 1e3 * (end - begin)
        return dict(total)

    def _around(self, stage: str, function: Callable) -> Callable:
        def staged(*args: Any, **named: Any) -> Any:
            self.mark()
            self._running.append(stage)
            try:
                return function(*args, **named)
            finally:
                self.mark()
                self._running.pop()

        return staged

    def _counting(self, ranks: Ranks, name: str, sent: Callable[..., int]) -> Callable:
        call = getattr(ranks, name)

        def counted(values: Tensor, *args: Any) -> Any:
            self.bytes[self._running[-1]] += sent(ranks, values, *args)
            return call(values, *args)

        return counted


def _sent(ranks: Ranks, rows: Tensor, sizes: list[int], *_: Any) -> int:
    width = rows.shape[1:].numel() * rows.element_size()
    return width * (sum(sizes) - sizes[ranks.rank])


def _copies(ranks: Ranks, values: Tensor, *_: Any) -> int:
    return (ranks.size - 1) * values.nbytes


def _ring(ranks: Ranks, values: Tensor) -> int:
    """Of a sum by a ring, which sends each part twice around."""
    return 2 * (ranks.size - 1) * values.nbytes // ranks.size
