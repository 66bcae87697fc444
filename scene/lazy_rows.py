"""Steps of Adam that SH coefficients take late, where views see a minority of the Gaussians.

A Gaussian that a view does not see has no gradient, but dense Adam moves its 59 values on, of which 48 are SH
coefficients. Nobody looks at these before a view sees the Gaussian, or something reads the whole model. So they wait,
and take the steps that they lack in one go, with the same bits (csrc/math/lazy_rows.h). That costs as many bytes as
a step, so it pays on a GPU where views see a minority.
"""

from collections import deque
from typing import Any

import utils.host.extensions  # noqa: F401  isort: skip  (before the extensions)
import torch
from diff_gaussian_rasterization.backend import OPERATORS
from torch import Tensor

from scene.gaussian_model import GaussianModel
from scene.gaussians.adam import GaussianAdam

_LAZY = ("f_dc", "f_rest")  # gs::kFirstLazy and on
_STEPS, _CONSTANTS = 256, 8  # gs::kLazySteps and gs::kLazyConstants
_SPAN = 240  # steps until all rows catch up: fewer than the ring has, by more than a host runs ahead
_PAYS = 0.4  # the largest share seen that lets rows wait
_VIEWS = 8  # whose shares are averaged
_FEWEST = 1 << 18  # rows; fewer are stepped sooner than a kernel is launched


class LazyRows:
    """The SH coefficients of a model that `FusedAdam` takes, as rows that may wait.

    active: whether rows may lack steps. Then nothing but the fused step may read or change them before `settle`.
    """

    active = False

    def __init__(self, gaussians: GaussianModel) -> None:
        self._gaussians = gaussians
        self._shares: deque[float] = deque(maxlen=_VIEWS)

    def observe(self, tile_counts: Tensor) -> None:
        """Note a view, by the tiles of each Gaussian in it. Waits for the device."""
        if len(tile_counts):
            self._shares.append(int(tile_counts.count_nonzero()) / len(tile_counts))

    @torch.no_grad()
    def begin(self) -> None:
        """Let rows wait from the next step on, if that pays. Whatever the answer, values get the same bits."""
        if self.active or not self._pays() or not self._able():
            return
        like = self._gaussians.get_xyz
        self._last = torch.full((len(like),), -1, dtype=torch.int32, device=like.device)  # each row takes its next step
        self._ring = like.new_zeros(_STEPS, len(_LAZY), _CONSTANTS)
        self._taken = torch.zeros(1, dtype=torch.int32, device=like.device)
        self.active = True

    @property
    def must_settle(self) -> bool:
        """Whether rows wait that may not wait any more, since somebody has changed the optimiser's options."""
        return self.active and not self._able()

    def catch_up_seen(self, scene: tuple[Any, ...]) -> None:
        """Let the rows that a view may see catch up, or all before the ring is full. scene: as `rasterize` takes it."""
        if self._number % _SPAN == 0:
            self.catch_up()
        else:
            OPERATORS.catch_up_seen_(*scene, *self._averages(), self._last, self._ring, self._taken)

    @torch.no_grad()
    def catch_up(self) -> None:
        """Let all rows catch up with the last step that was taken."""
        if self.active:
            values = map(self._gaussians.raw, _LAZY)
            OPERATORS.catch_up_(*values, *self._averages(), self._last, self._ring, self._taken)

    def settle(self) -> None:
        """Let all rows catch up, and none wait any more. All steps must be done, or given up."""
        self.catch_up()
        self.active = False

    def arguments(self) -> dict[str, Any]:
        """Arguments of `rasterize_vjp_step_` for the next step."""
        return {"last_steps": self._last, "ring": self._ring, "taken": self._taken, "number": self._number}

    @property
    def _number(self) -> int:
        """That of the next step. A step that is repeated has its old number, since counters are rewound for it."""
        return int(self._gaussians.optimizer.state_of(self._gaussians.raw("f_dc"))["step"]) + 1

    def _averages(self) -> tuple[list[Tensor], list[Tensor], list[int]]:
        optimizer, lists = self._gaussians.optimizer, ([], [], [])
        for name in _LAZY:
            param = self._gaussians.raw(name)
            state = optimizer.state_of(param) if param.numel() else {"exp_avg": param, "exp_avg_sq": param}
            entries = state["exp_avg"], state["exp_avg_sq"], optimizer.active_columns(name)
            for to, entry in zip(lists, entries, strict=True):
                to.append(entry)
        return lists

    def _pays(self) -> bool:
        rows, shares = self._gaussians.get_xyz, self._shares
        # On two cores of a CPU, late steps take as long to compute as the memory traffic that they save.
        return rows.is_cuda and len(rows) >= _FEWEST and len(shares) > 0 and sum(shares) / len(shares) <= _PAYS

    def _able(self) -> bool:
        """Whether the optimiser's present options let rows wait: the dense one, with sound rates, betas and eps."""
        optimizer = self._gaussians.optimizer
        (beta1, beta2), eps = optimizer.defaults["betas"], optimizer.defaults["eps"]
        rates = [group["lr"] for group in optimizer.param_groups if group["name"] in _LAZY]
        return (
            type(optimizer) is GaussianAdam
            and all(0 <= r <= 1 for r in [*rates, eps])
            and (
                0 <= beta1 <= 0.99 and 0 <= beta2 <= 0.9999999 and eps >= 1e-16  # as gs::may_wait has it
            )
        )
