"""Adaptive density control (Kerbl et al. 2023, section 5.2) of a set of Gaussians."""

from dataclasses import replace
from operator import attrgetter

import torch
from torch import Tensor

from scene.gaussians import density_rules as rules
from scene.gaussians.adam import GaussianAdam
from scene.gaussians.attributes import Rows
from scene.gaussians.parameters import GaussianParameters
from scene.gaussians.statistics import Statistics


def _statistic(name: str) -> property:
    """A property that reads one tensor of `statistics`, and replaces it for this model but not for copies of it."""

    def put(self: "AdaptiveGaussians", values: Tensor) -> None:
        self.statistics = replace(self.statistics, **{name: values})

    return property(attrgetter(f"statistics.{name}"), put)


class AdaptiveGaussians(GaussianParameters):
    """Gaussians that density control clones, splits and removes, together with their optimiser state.

    statistics: observations since the last densification, whose tensors can be read and replaced here, too. optimizer:
    None until training is set up. percent_dense: largest scale, as a part of
    the scene's extent, of a Gaussian that is cloned; a larger one is split.
    """

    statistics: Statistics
    max_radii2D = _statistic("max_radii2D")
    xyz_gradient_accum = _statistic("xyz_gradient_accum")
    denom = _statistic("denom")
    optimizer: GaussianAdam | None = None
    percent_dense = 0.0

    def set_rows(self, rows: Rows) -> None:
        """Take raw values as GaussianParameters does, with new statistics."""
        super().set_rows(rows)
        self._zero_statistics()

    def part(self, keep: Tensor | slice, sh_degree: int) -> "AdaptiveGaussians":
        """A copy of the Gaussians `keep` as GaussianParameters makes it, without an optimiser."""
        other = super().part(keep, sh_degree)
        other.optimizer = None
        return other

    def _zero_statistics(self) -> None:
        self.statistics = Statistics.zero(len(self), self._xyz.device)

    def observe(self, viewspace_points: Tensor, radii: Tensor) -> None:
        """Add a view to the statistics: largest radius, gradient length and count of the Gaussians it saw.

        viewspace_points: (N, 3) with `.grad` per NDC unit; radii: (N,) int32 pixels, 0 where not seen. One pass updates
        max_radii2D and does the work of add_densification_stats for radii > 0.
        """
        self.statistics.observe(viewspace_points.grad, radii)

    def add_densification_stats(self, viewspace_point_tensor: Tensor, update_filter: Tensor) -> None:
        """Add this view's screen-space gradient lengths and count it, for the Gaussians it saw.

        viewspace_point_tensor: (N, 3) with `.grad` per NDC unit; update_filter: indices (n,) or (n, 1), or a mask (N,).
        """
        self.statistics.add_gradient(viewspace_point_tensor.grad, update_filter)

    def drop_broken_statistics(self) -> None:
        """Restart the statistics of Gaussians whose sum of gradients is not finite."""
        self.statistics.drop_broken()

    def take_from_optimizer(self) -> None:
        """Adopt the rows that densification had reached when memory ran out, so that they can be saved."""
        self._take({group["name"]: group["params"][0] for group in self.optimizer.param_groups})
        if not self.statistics.fit(len(self)):
            self._zero_statistics()

    def densify_and_prune(
        self,
        max_grad: float,
        min_opacity: float,
        extent: float,
        max_screen_size: int | None,
        *,
        seed: int = 0,
        iteration: int = 0,
        max_splats: int = 0,
    ) -> None:
        """Clone small and split large Gaussians with a mean gradient >= max_grad, then remove useless ones.

        min_opacity: a Gaussian below it is removed. extent: of the scene, world units. max_screen_size: pixels; unless
        None, Gaussians wider than that or than a tenth of the extent are removed. seed and iteration decide the
        positions of split children. max_splats > 0 bounds the number of Gaussians.
        """
        self.optimizer.zero_grad(set_to_none=True)  # frees memory; the new parameters have no gradient anyway
        gradient = rules.mean_gradient(self.xyz_gradient_accum, self.denom)
        if max_splats > 0:
            gradient = rules.limit_growth(gradient, max_grad, max_splats - len(self))
        self.densify_and_clone(gradient, max_grad, extent)
        self.densify_and_split(gradient, max_grad, extent, seed=seed, iteration=iteration)
        remove = rules.is_useless(self._opacity, min_opacity)
        if max_screen_size:
            # Appending has just zeroed max_radii2D, so the first test never fires, as in the reference.
            remove |= self.max_radii2D > max_screen_size
            remove |= ~rules.is_small(self._scaling, rules.PRUNE_EXTENT * extent)
        self.prune_points(remove)

    def densify_and_clone(self, grads: Tensor, grad_threshold: float, scene_extent: float) -> None:
        """Append an exact copy of each Gaussian with gradient >= threshold and scale <= percent_dense * extent."""
        small = rules.is_small(self._scaling, self.percent_dense * scene_extent)
        chosen = ((grads.reshape(-1) >= grad_threshold) & small).nonzero().reshape(-1)
        self.densification_postfix(*(values.index_select(0, chosen) for values in self.rows().values()))

    def densify_and_split(
        self,
        grads: Tensor,
        grad_threshold: float,
        scene_extent: float,
        N: int = 2,
        *,
        seed: int = 0,
        iteration: int = 0,
    ) -> None:
        """Replace each Gaussian with gradient >= threshold and scale > percent_dense * extent by N smaller ones.

        grads: (n,) or (n, 1) for the first n Gaussians; those appended since (fresh clones) have gradient 0.
        """
        before = len(self)
        large = ~rules.is_small(self._scaling, self.percent_dense * scene_extent)
        grads = grads.reshape(-1)
        large[len(grads) :] = False
        large[: len(grads)] &= grads >= grad_threshold
        parents = large.nonzero().reshape(-1)
        rows = {name: values.index_select(0, parents) for name, values in self.rows().items()}
        children = [
            rules.split_children(
                rows["xyz"], rows["scaling"], rows["rotation"], parents, child, seed=seed, iteration=iteration
            )
            for child in range(N)
        ]
        rows = {name: torch.cat([values] * N) for name, values in rows.items()}
        rows["xyz"], rows["scaling"] = (torch.cat(parts) for parts in zip(*children, strict=True))
        self.densification_postfix(*rows.values())
        self.prune_points(torch.cat((large, large.new_zeros(len(self) - before))))

    def densification_postfix(
        self,
        new_xyz: Tensor,
        new_features_dc: Tensor,
        new_features_rest: Tensor,
        new_opacities: Tensor,
        new_scaling: Tensor,
        new_rotation: Tensor,
        *new_others: Tensor,
    ) -> None:
        """Append Gaussians, possibly none, by raw parameters, and zero the statistics of all."""
        new = (new_xyz, new_features_dc, new_features_rest, new_opacities, new_scaling, new_rotation, *new_others)
        self._take(self.optimizer.append_rows(dict(zip(self._attributes, new, strict=True))))
        self._zero_statistics()

    def prune_points(self, mask: Tensor) -> None:
        """Remove the Gaussians of a mask (N,) bool, with their optimiser state and statistics."""
        keep = (~mask).nonzero().reshape(-1)
        if len(keep) == len(self):
            return
        self._take(self.optimizer.keep_rows(keep))
        self.statistics = self.statistics.keep(keep)

    def reset_opacity(self) -> None:
        """Lower every opacity to at most 0.01; Adam's averages of it restart at zero."""
        lowered = self._opacity.detach().clamp_max(rules.logit(rules.RESET_OPACITY))
        self._opacity = self.optimizer.reset("opacity", lowered)
