"""The trained model with a part of it in the host's memory (`--spill`)."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import splatting.host.extensions  # noqa: F401  isort: skip  (before the extensions)
import torch
from diff_gaussian_rasterization.optim import catch_up_
from torch import Tensor, nn

from scene.gaussian_model import GaussianModel
from scene.gaussians.adam import Part, SparseGaussianAdam
from scene.gaussians.table import GaussianTable, in_host_memory

_MOST_MISSED = 1000  # steps, after which all rows catch up, so that the list of steps stays short


class _SideStream:
    """Runs copies between a GPU and its host beside the current stream of a GPU; on the CPU at once."""

    def __init__(self) -> None:
        self._stream: torch.cuda.Stream | None = None

    @contextmanager
    def aside(self, *used: Tensor) -> Iterator[Callable[[Tensor], Tensor]]:
        """Queue what is done here behind the work so far, and let the current stream go on.

        used: tensors that it reads. Yields what a new tensor goes through that the current stream shall use.
        """
        if not used[0].is_cuda:
            yield lambda made: made
            return
        here = torch.cuda.current_stream(used[0].device)
        self._stream = self._stream or torch.cuda.Stream(used[0].device)
        self._stream.wait_stream(here)
        for tensor in used:
            tensor.record_stream(self._stream)

        def keep(made: Tensor) -> Tensor:
            made.record_stream(here)
            return made

        with torch.cuda.stream(self._stream):
            yield keep

    def join(self) -> None:
        """Let the current stream wait for all that was queued here."""
        if self._stream is not None:
            torch.cuda.current_stream(self._stream.device).wait_stream(self._stream)


class _Missed:
    """Steps of Adam that some rows have not taken yet.

    rates, steps: of each its learning rate and number. taken: (N,) int32, how many of them a row has taken. columns:
    how many values of a row take these steps.
    """

    def __init__(self) -> None:
        self.rates: list[float] = []
        self.steps: list[float] = []
        self.taken: Tensor | None = None
        self.columns = -1


class _Seen(NamedTuple):
    """The rows of a view, and copies of what they have in the host's memory: values and averages (n, bands, 3)."""

    rows: Tensor
    gaussians: GaussianModel
    copies: tuple[Tensor, Tensor, Tensor] | None


class SpilledGaussians(GaussianModel):
    """A GaussianModel whose SH bands above 0, with their averages, lie in the host's memory; on the CPU the same one.

    A step concerns copies of the rows that a view sees: `fetch` makes them, `take_gradients` takes their gradients, and
    `step` writes them back. `fetch_ahead` copies rows of the next step beside the present one. Unseen rows replay the
    steps of Adam that they skipped, each with its own rate and correction: when a view sees them, or before anybody
    reads the bands of all Gaussians or their averages through this class.
    """

    def __init__(self, sh_degree: int, optimizer_type: str = "default") -> None:
        self._missed, self._seen, self._copies = _Missed(), None, _SideStream()
        # Rows and their copies, as they are in the host's memory.
        self._near: list[tuple[Tensor, Sequence[Tensor]]] = []
        super().__init__(sh_degree, optimizer_type)

    @property
    def _features_rest(self) -> Tensor:
        self.catch_up()
        return self._rest

    @_features_rest.setter
    def _features_rest(self, values: Tensor) -> None:
        values.data = in_host_memory(values.data)
        self._rest, self._missed, self._near = values, _Missed(), []

    @torch.no_grad()
    def catch_up(self) -> None:
        """Let all rows take the steps that they have missed."""
        self._copies.join()
        self._near = []
        missed = self._missed
        if missed.steps:
            self._missed = _Missed()
            self._take_missed(missed, missed.taken, self._stored(), missed.columns)

    def _take_missed(self, missed: _Missed, taken: Tensor, tensors: list[Tensor], columns: int = -1) -> None:
        defaults = self.optimizer.defaults
        catch_up_(*tensors, taken, missed.rates, missed.steps, *defaults["betas"], defaults["eps"], columns)

    def _stored(self) -> list[Tensor]:
        """Values and averages (N, K, 3) of all rows; without the averages before there are any."""
        state = {} if self.optimizer is None else self.optimizer.state.get(self._rest, {})
        return [self._rest.detach(), *(state[name] for name in ("exp_avg", "exp_avg_sq") if name in state)]

    # What a step does

    @torch.no_grad()
    def fetch(self, rows: Tensor) -> GaussianModel:
        """A model of the rows (n,), ascending, for a view that sees no others; `take_gradients` wants its gradients."""
        values = {name: self.raw(name) for name in self._attributes if name != "f_rest"}
        params = {name: nn.Parameter(value.detach().index_select(0, rows)) for name, value in values.items()}
        copies = self._fetch_stored(rows) if self.active_sh_bands else None
        params["f_rest"] = nn.Parameter(copies[0]) if copies else self._rest.new_empty(len(rows), 0, 3)
        seen = GaussianModel.__new__(GaussianModel)
        vars(seen).update(vars(self))
        seen._take(params)
        self._seen = _Seen(rows, seen, copies)
        return seen

    def _fetch_stored(self, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        near, self._near = self._near, []
        known = torch.cat([rows[:0], *(there for there, _ in near)])
        place = torch.full((len(self),), -1, device=rows.device)
        place[known] = torch.arange(len(known), device=rows.device)
        place = place[rows]
        far = place < 0
        late = self._copied(rows[far])
        self._copies.join()
        index = torch.where(far, len(known) + far.cumsum(0) - 1, place)
        each = zip(*(copies for _, copies in near), late, strict=True)
        found = [torch.cat(parts).index_select(0, index) for parts in each]
        found += [torch.zeros_like(found[0]) for _ in range(3 - len(found))]
        missed = self._missed
        if missed.steps:
            self._take_missed(missed, missed.taken[rows], found)
        return tuple(found)

    def _copied(self, rows: Tensor) -> list[Tensor]:
        """Copies (n, bands, 3) of what rows have in the host's memory; before use, the current stream has to wait."""
        with self._copies.aside(rows) as keep:
            return [keep(stored[:, : self.active_sh_bands].index_select(0, rows)) for stored in self._stored()]

    @torch.no_grad()
    def fetch_ahead(self, rows: Tensor) -> None:
        """Begin to copy the rows (n,) of the next `fetch`, except rows that this step updates."""
        if self._seen.copies and len(self._stored()) == 3:
            fresh = torch.ones(len(self), dtype=torch.bool, device=rows.device)
            fresh[self._seen.rows] = False
            rows = rows[fresh[rows]]
            self._near.append((rows, self._copied(rows)))

    @torch.no_grad()
    def take_gradients(self) -> Tensor:
        """Take the gradients of the last `fetch`, zeros for other rows; none are made for the bands above 0.

        These get a stand-in that tells whether their rows still have a gradient. A parameter that got no gradient has
        none here, and the optimiser passes it over. Returns the rows.
        """
        rows, seen, copies = self._seen
        for name in self._attributes:
            if name != "f_rest":
                param, gradient = self.raw(name), seen.raw(name).grad
                param.grad = None if gradient is None else torch.zeros_like(param).index_copy_(0, rows, gradient)
        if copies:
            self._rest.grad = copies[0].new_zeros(()).expand_as(self._rest)
        return rows

    def step(self, radii: Tensor) -> None:
        """Step all optimisers as GaussianModel does, and write back the rows of the view."""
        steps = self._rest.grad is not None  # nobody has changed rows since, or dropped gradients
        if steps:
            rows, seen, copies = self._seen
            gradient = seen._features_rest.grad
            gradient = torch.zeros_like(copies[0]) if gradient is None else gradient
            self.optimizer.parts = {"f_rest": Part(rows, copies[0], gradient, *copies[1:])}
        super().step(radii)
        self._seen = None
        if steps:
            self.optimizer.parts = {}
            self._note_step()
            self._write_back(rows, copies)

    @torch.no_grad()
    def _note_step(self) -> None:
        """Take note of a step that the rows out of view have missed."""
        if isinstance(self.optimizer, SparseGaussianAdam) or not self._guard_let_step():
            return
        missed = self._missed
        (group,) = (group for group in self.optimizer.param_groups if group["name"] == "f_rest")
        missed.rates.append(group["lr"])
        missed.steps.append(float(self.optimizer.state[self._rest]["step"]))
        missed.columns = 3 * self.active_sh_bands
        if missed.taken is None:
            missed.taken = torch.zeros(len(self), dtype=torch.int32, device=self._rest.device)

    def _guard_let_step(self) -> bool:
        """Whether values took the last step; waits for the device."""
        guard = self.optimizer.guard
        if not guard or not guard.arguments:
            return True
        loss, _, iteration = guard.arguments
        return guard.stopped_in() in (0, iteration) and bool(loss.isfinite())

    @torch.no_grad()
    def _write_back(self, rows: Tensor, copies: tuple[Tensor, Tensor, Tensor]) -> None:
        missed = self._missed
        if missed.taken is not None:
            missed.taken[rows] = len(missed.steps)
        with self._copies.aside(rows, *copies):
            for stored, copy in zip(self._stored(), copies, strict=True):
                stored[:, : copy.shape[1]].index_copy_(0, rows, copy)
        self._near.append((rows, copies))
        if len(missed.steps) >= _MOST_MISSED:
            self.catch_up()

    # What reads or changes all rows

    def oneupSHdegree(self) -> None:
        """Raise the active SH degree, after the steps of the one before."""
        self.catch_up()
        super().oneupSHdegree()

    def take_marks(self) -> list[tuple[str, list[int] | list[str], int]]:
        """Values whose step a guard held back, as GaussianModel tells them."""
        self.catch_up()
        return super().take_marks()

    @property
    def table(self) -> GaussianTable:
        """The table of GaussianModel, after the steps that rows have missed."""
        self.catch_up()
        return super().table
