"""Gaussians that are relocated and multiply by division, and move at random (Kheradmand et al. 2024)."""

import math

import splatting.host.extensions  # noqa: F401  isort: skip  (before the extensions)
import torch
from diff_gaussian_rasterization.density import add_noise_, penalise_
from torch import Tensor

from scene.gaussians.adaptive import AdaptiveGaussians
from scene.gaussians.attributes import Rows
from scene.gaussians.density_rules import logit
from scene.gaussians.moves import changes_rows, rows_by_draw
from scene.gaussians.parameters import raw_rows
from scene.gaussians.penalty import Penalty
from scene.gaussians.relocation import divided, draw, opacity_units
from scene.gaussians.row_surgery import overwrite_rows, row_groups
from splatting.deterministic.counter_rng import Stream

_RELOCATION, _GROWTH = range(2)  # draws of one iteration


class RelocatingGaussians(AdaptiveGaussians):
    """Gaussians with the steps of the MCMC strategy besides those of adaptive density control."""

    def start_as(self, opacity: float, scale: float) -> None:
        """Give all Gaussians an opacity, and multiply their scales; call it before the first step."""
        with torch.no_grad():
            logits, log_scales = torch.full_like(self._opacity, logit(opacity)), self._log_scales() + math.log(scale)
            for name, values in self._raw_shapes(logits, log_scales).items():
                self.raw(name).copy_(values)

    def relocate(self, min_opacity: float, most_parts: int, *, seed: int, iteration: int) -> int:
        """Move the Gaussians of an opacity <= min_opacity to others, which are drawn in proportion to their opacity.

        A Gaussian and those that have come to it are equal parts of what it was, as far as these are at most
        `most_parts`. Adam's averages of all of them restart at zero. seed and iteration decide the random numbers.
        Returns the number of such Gaussians; if all are, nothing changes.
        """
        live = self._opacity_logits().reshape(-1) > logit(min_opacity)
        dead = (~live).nonzero().reshape(-1)
        counts = self.shards.ranks.numbers(len(dead))[:, 0]
        count = int(counts.sum())
        if 0 < count < self.total:
            draws, origins = self._divide(live, count, most_parts, seed, iteration, _RELOCATION)
            rows = {name: values.index_select(0, origins) for name, values in raw_rows(self).items()}
            self._overwrite(dead, rows_by_draw(rows, draws, counts, self.shards.ranks))
        return count

    @changes_rows
    def grow(self, count: int, most_parts: int, *, seed: int, iteration: int) -> None:
        """Append `count` Gaussians, which are parts of others as `relocate` makes them."""
        every = torch.ones(len(self), dtype=torch.bool, device=self._xyz.device)
        draws, origins = self._divide(every, count, most_parts, seed, iteration, _GROWTH)
        self._append({name: values.index_select(0, origins) for name, values in raw_rows(self).items()}, origins)
        self.shards.order(draws)

    @torch.no_grad()
    def add_noise(self, size: float, steepness: float, threshold: float, *, seed: int, iteration: int) -> None:
        """Move every centre by size g C n: its covariance C, standard normal n, g = sigmoid(steepness (threshold - o)).

        o: the opacity. seed and iteration decide n. Nothing moves once a guard holds steps back.
        """
        shapes = self._log_scales(), self._rotation, self._opacity_logits()
        gate = {"size": size, "steepness": steepness, "threshold": threshold}
        numbers = {"seed": seed, "stream": Stream.NOISE, "iteration": iteration}
        guard = getattr(self.optimizer, "guard", None)
        where = {"stopped": guard.stopped if guard else None, "first": self.shards.first}
        add_noise_(self._xyz, *shapes, **gate, **numbers, **where)

    def penalise(self, penalty: Penalty) -> None:
        """Add a penalty's gradients to those of the parameters, with the bits of the step that adds them itself."""
        if not self.kernels_activate:
            total = self.total
            opacity, scale = self.get_opacity.sum() / total, self.get_scaling.sum() / (3 * total)
            return (penalty.opacity * opacity + penalty.scale * scale).backward()
        params = self._opacity, self._scaling
        for param in params:
            if param.grad is None:
                param.grad = torch.zeros_like(param)
        each = penalty.of_each(self.total)
        gradients = [param.grad.contiguous() for param in params]
        penalise_(*(param.detach() for param in params), *gradients, opacity=each.opacity, scale=each.scale)
        for param, gradient in zip(params, gradients, strict=True):
            param.grad = gradient

    def _divide(
        self, live: Tensor, count: int, most: int, seed: int, iteration: int, which: int
    ) -> tuple[Tensor, Tensor]:
        """Draw the origins of `count` new Gaussians among those of `live`, and make each a part of what it was.

        Returns which draws (n,) fell on this rank's Gaussians, and the origins (n,).
        """
        logits = self._opacity_logits().reshape(-1)
        units = torch.where(live, opacity_units(logits), 0)
        numbers = {"seed": seed, "iteration": iteration, "draw": which}
        draws, origins = draw(units, count, **numbers, ranks=self.shards.ranks)
        sources, copies = origins.unique(return_counts=True)
        opacities, larger = divided(logits[sources], (copies + 1).clamp_max(most))
        log_scales = self._log_scales()[sources] + larger[:, None]
        self._overwrite(sources, self._raw_shapes(opacities[:, None].float(), log_scales.float()))
        return draws, origins

    def _overwrite(self, indices: Tensor, rows: Rows) -> None:
        groups, others, states = self._groups()
        overwrite_rows(row_groups(groups + others, len(self)), states, indices, rows)

    def _raw_shapes(self, logits: Tensor, log_scales: Tensor) -> Rows:
        """Raw opacities and scales from logits and log scales, whatever their activations are."""
        if self.kernels_activate:
            return {"opacity": logits, "scaling": log_scales}
        opacity = self.inverse_opacity_activation(logits.sigmoid())
        return {"opacity": opacity, "scaling": self.scaling_inverse_activation(log_scales.exp())}
