"""Blocks of Gaussians that sleep: a step costs only the Gaussians that its view may show, and Adam stays dense.

Steps of a row without gradient depend on Adam's averages alone, and have a closed form (csrc/math/sleep.h of the
rasterizer). So a block of 128 rows that a view certainly does not show is skipped, and takes all missed steps when a
view may show it. Rows lie along a Morton curve, so most blocks are small in space. Every REST iterations all blocks
wake, so that saved files are complete.
"""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import groundwork.host.extensions  # noqa: F401  isort: skip  (before the extensions)
import torch
from diff_gaussian_rasterization.backend import OPERATORS
from diff_gaussian_rasterization.scene import Scene
from torch import Tensor

from groundwork.ranks.rows import BLOCK, PIECE
from scene.fused_adam import FusedAdam
from scene.gaussian_model import GaussianModel
from scene.gaussians.spilled import is_spilled, to_host
from scene.in_view import share_of
from utils.system_utils import UserError

REST = 100  # iterations
MOST_SHARE = 0.7  # of the points, seen by a view on average; where more are, sleep saves nothing
_TERMS = 128, 8  # of past steps, for each attribute (gs::SleepInput)
_NAMES = "xyz", "opacity", "scaling", "rotation", "f_dc", "f_rest"  # in the order of gs::Stepped

State = dict[str, Any]  # awake, taken and terms, and of the rows that sleep all that a step changes


def saves_time(scene: Any, device: torch.device) -> bool:
    """Tell whether views of a scene see so few of its points that blocks should sleep."""
    return share_of(scene, device) < MOST_SHARE


class Sleeping:
    """The sleeping blocks of a model, and the steps that they have missed."""

    def __init__(self, gaussians: GaussianModel) -> None:
        """Start with all blocks of a model awake."""
        self._gaussians, self._adam = gaussians, FusedAdam(gaussians)
        self._terms = gaussians._xyz.detach().new_zeros(_TERMS)
        self.awake = self._terms.new_empty(0, dtype=torch.uint8)
        self._taken = self._terms.new_empty(0, dtype=torch.int32)
        self._asleep: State | None = None  # while somebody looks: what all was before
        self.reset()

    def reset(self) -> None:
        """Take note that all rows have taken the same steps: all blocks are awake, and none has missed a step."""
        rows = self._gaussians._xyz
        blocks = -(-len(rows) // BLOCK)
        taken = int(self._gaussians.optimizer.state_of(rows)["step"])
        if len(self.awake) != blocks:
            self.awake = torch.ones(blocks, dtype=torch.uint8, device=rows.device)
            self._taken = torch.zeros(blocks, dtype=torch.int32, device=rows.device)
        self.awake.fill_(1)
        self._taken.fill_(taken)
        self._is_whole = True

    def wake(self, scene: Scene, now: Tensor | None = None) -> Tensor:
        """Wake the blocks that the scene's camera may show, before a step.

        now: the step's numbers (NOW_WORDS,) int64 that `FusedAdam.write_now` has written, copied to the GPU, where a
        CUDA graph reads them; None: they are taken from the optimiser.

        Returns the blocks that are awake for the rasterizer: on a GPU their list, so that only these cost time; on a
        CPU, and with several ranks, a flag for each block.
        """
        blocks = self._wake(scene, False, now)
        return self.awake if blocks is None or self._gaussians.shards.ranks.several else blocks

    def stepped(self) -> None:
        """Note that a step was taken, or taken back: blocks that sleep have then missed steps."""
        self._is_whole = False

    def after_step(self, iteration: int, changes: bool) -> None:
        """Note the step of an iteration. changes: rows or views have changed, so that all blocks were awake."""
        if changes:
            self.reset()
        elif self.flushes(iteration):
            self.flush()
        else:
            self.stepped()

    def flushes(self, iteration: int) -> bool:
        """Tell whether all blocks wake after the step of an iteration."""
        return iteration % REST == 0

    def flush(self) -> None:
        """Let all blocks take the steps that they have missed. They may sleep in the next step again."""
        if self._asleep is not None:
            self._put_back(self._asleep)
            self._asleep = None
        self._wake(self._make_any_view(), True)
        self._is_whole = True

    def rows(self) -> Tensor:
        """Mark the rows that are awake, (N,) bool."""
        return self.awake.bool().repeat_interleave(BLOCK)[: len(self._gaussians._xyz)]

    @contextmanager
    def flushed_view(self) -> Iterator[None]:
        """Return a context in which the model is as if no block had ever slept, for others to read.

        All blocks take their missed steps at its begin. At its end the model is restored to the bit.
        """
        if self._is_whole:
            yield
            return
        states = {"awake": self.awake, "taken": self._taken, "terms": self._terms}
        self._asleep = {name: values.clone() for name, values in states.items()} | {"rows": self._copy_sleeping_rows()}
        self._wake(self._make_any_view(), True)
        try:
            yield
        finally:
            if self._asleep is not None:
                self._put_back(self._asleep)
                self._asleep = None

    def captured(self) -> State | None:
        """Return what a checkpoint that is written within `flushed_view` has to keep of the sleep before it.

        None if no block slept. Every rank must call it.
        """
        if self._asleep is None:
            return None
        whole = self._gaussians.shards.gather_whole
        changed = {name: whole(self._asleep[name]) for name in ("awake", "taken")}
        return self._asleep | changed | {"rows": [whole(values) for values in self._asleep["rows"]]}

    def restore(self, captured: State) -> None:
        """Restore the sleep of blocks from `captured`. UserError if it does not fit the model."""
        shards, count = self._gaussians.shards, len(self._gaussians)
        first = shards.first // BLOCK
        try:
            asleep = (captured["awake"] == 0).repeat_interleave(BLOCK)
            before = int(asleep[: shards.first].sum())
            own = int(asleep[shards.first : shards.first + count].sum())
            blocks = slice(first, first + len(self.awake))
            taken = captured["taken"][blocks]
            behind = self._taken.cpu() - taken.cpu()  # -1: woken for a step that memory did not suffice for
            if not ((behind >= -1) & (behind < _TERMS[0])).all():
                raise ValueError("blocks have missed more steps than are known")
            self._put_back(
                {"awake": captured["awake"][blocks], "taken": taken, "terms": captured["terms"].view(_TERMS)}
                | {"rows": [values[before : before + own] for values in captured["rows"]]}
            )
        except (AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
            raise UserError(
                f"the state of sleeping blocks in the checkpoint does not fit ({error}); use another checkpoint"
            ) from error

    def _put_back(self, state: State) -> None:
        """Restore the blocks, then the values and averages of the rows that sleep in them, from a state."""
        self.awake.copy_(state["awake"])
        self._taken.copy_(state["taken"])
        self._terms.copy_(state["terms"])
        rows = self._list_sleeping_rows()
        for values, kept in zip(self._list_changed_tensors(), state["rows"], strict=True):
            for part, piece in zip(rows.split(PIECE), kept.split(PIECE), strict=True):  # the GPU may have little room
                values.index_copy_(0, part, piece.to(values.device))
        self._is_whole = False

    def _copy_sleeping_rows(self) -> list[Tensor]:
        """Copy what `flushed_view` changes of the sleeping rows (K), so that `_put_back` can restore it to the bit.

        Returns a tensor (K, ...) for each one of `_list_changed_tensors`, in that order; on the host if the device
        has no memory left.
        """
        rows, moved = self._list_sleeping_rows(), self._list_changed_tensors()
        if not (self._gaussians.storage and any(map(is_spilled, moved))):
            with suppress(torch.OutOfMemoryError):
                return [values[rows] for values in moved]
        return [to_host(values, rows) for values in moved]

    def _list_sleeping_rows(self) -> Tensor:
        return (~self.rows()).nonzero().reshape(-1)

    def _list_values(self) -> list[Tensor]:
        return [self._gaussians.raw(name).detach() for name in _NAMES]

    def _list_changed_tensors(self) -> list[Tensor]:
        """List the tensors (N, ...) that a step changes: six attributes, then exp_avg and exp_avg_sq of each."""
        states = [self._gaussians.optimizer.state_of(self._gaussians.raw(name)) for name in _NAMES]
        return [*self._list_values(), *(state[name] for state in states for name in ("exp_avg", "exp_avg_sq"))]

    def _make_any_view(self) -> Scene:
        """Make the rasterizer's arguments to wake all blocks: the Gaussians, and any camera, which is not read."""
        means, opacities, scales, rotations, sh_dc, sh_rest = self._list_values()
        matrix, center = torch.eye(4, device=means.device), means.new_zeros(3)
        shapes = means, opacities, scales, rotations, None, None
        return Scene(*shapes, sh_dc, sh_rest, matrix, matrix, center, (1.0, 1.0, 1.0), (16, 16, 0, False, True))

    def _wake(self, scene: Scene, every: bool, now: Tensor | None = None) -> Tensor | None:
        step, sleep = self._adam.arguments(False), [self.awake, self._taken, self._terms]
        lists = step.averages, step.steps, step.guard, step.attributes, step.rates, step.constants, step.columns
        return OPERATORS.wake_(*scene.lists, sleep, every, *lists, step.iteration, now)
