"""Adaptive density control (Kerbl et al. 2023, section 5.2) of a set of Gaussians."""

from operator import attrgetter

import torch
from torch import Tensor, nn

from scene.gaussians import density_rules as rules
from scene.gaussians.attributes import Rows
from scene.gaussians.long_axis import long_axis_children
from scene.gaussians.moves import changes_rows
from scene.gaussians.parameters import GaussianParameters, raw_rows
from scene.gaussians.row_surgery import Group, States, append_rows, keep_rows, replace_values, row_groups
from scene.gaussians.statistics import NAMES, Statistics
from utils.general_utils import inverse_sigmoid

_STANDARD = ("xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation")  # the order of densification_postfix
_read_statistics = attrgetter(*NAMES)


class AdaptiveGaussians(GaussianParameters):
    """Gaussians that density control clones, splits and removes, together with their optimiser state.

    max_radii2D, xyz_gradient_accum, denom: observations since the last densification (Statistics has shapes and units).
    optimizer: any of torch's, with `name` in its groups; None until training is set up, and then rows alone change.
    tmp_radii: (N,) pixels of the present view, or None; density control keeps it in step with the rows. percent_dense:
    largest scale, as a part of the scene's extent, of a Gaussian that is cloned; a larger one is split.
    """

    max_radii2D: Tensor
    xyz_gradient_accum: Tensor
    denom: Tensor
    optimizer: torch.optim.Optimizer | None = None
    tmp_radii: Tensor | None = None
    percent_dense = 0.0

    def __init__(self, sh_degree: int) -> None:
        super().__init__(sh_degree)
        self._zero_statistics()

    @property
    def statistics(self) -> Statistics:
        """The observations since the last densification, in one record of the model's own tensors."""
        return Statistics(*_read_statistics(self))

    @statistics.setter
    def statistics(self, statistics: Statistics) -> None:
        for name in NAMES:
            setattr(self, name, getattr(statistics, name))

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
        max_radii2D and does the work of add_densification_stats for radii > 0. Several views at once: (V, N, 3) and
        (V, N).
        """
        for gradient, pixels in _views(viewspace_points.grad, radii):
            self.statistics.observe(gradient, pixels)

    def observe_absolute(self, viewspace_points: Tensor, radii: Tensor) -> None:
        """Do as observe with the lengths of absolute gradients, of a `render` with want_absolute_gradient."""
        for gradient, pixels in _views(viewspace_points.grad, radii):
            self.statistics.observe(gradient[:, 2], pixels)

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
        self._take({group.get("name"): group["params"][0] for group in self.optimizer.param_groups})
        if not self.statistics.fit(len(self)):
            self._zero_statistics()

    @changes_rows
    def densify_and_prune(
        self,
        max_grad: float,
        min_opacity: float,
        extent: float,
        max_screen_size: int | None,
        radii: Tensor | None = None,
        *,
        seed: int | None = None,
        iteration: int = 0,
        max_splats: int = 0,
        long_axis: bool = False,
    ) -> None:
        """Clone small and split large Gaussians with a mean gradient >= max_grad, then remove useless ones.

        min_opacity: a Gaussian below it is removed. extent: of the scene, world units. max_screen_size: pixels; unless
        None, Gaussians wider than that or than a tenth of the extent are removed. radii: (N,) pixels of this view,
        `tmp_radii` until the end. seed and iteration decide the positions of split children; without a seed, torch's
        generator draws one. max_splats > 0 bounds the number of Gaussians. long_axis: split along the longest axis
        (scene/gaussians/long_axis.py) instead, without random numbers.
        """
        if radii is not None:
            self.tmp_radii = radii
        for attribute in self._attributes.values():  # frees memory; the new parameters have no gradient anyway
            getattr(self, attribute.field).grad = None
        gradient = rules.mean_gradient(self.xyz_gradient_accum, self.denom)
        if max_splats > 0:
            room = max_splats - self.total
            gradient = rules.limit_growth(gradient, max_grad, room, self.shards.ranks)
        how = {} if seed is None else {"seed": seed, "iteration": iteration}
        if long_axis:  # said only then, as a client's own densify_and_split may not know it
            how["long_axis"] = True
        split = None
        if self._grows_by_own_steps():
            split = self._clone_and_split(gradient, max_grad, extent, **how)
        else:
            self.densify_and_clone(gradient, max_grad, extent)
            self.densify_and_split(gradient, max_grad, extent, **how)
        remove = rules.is_useless(self._opacity_logits(), min_opacity)
        if split is not None:
            remove[: len(split)] |= split
        if max_screen_size:
            # Appending has just zeroed max_radii2D, so the first test never fires, as in the reference.
            remove |= self.max_radii2D > max_screen_size
            remove |= ~rules.is_small(self._log_scales(), rules.PRUNE_EXTENT * extent)
        self.prune_points(remove)
        if radii is not None:
            self.tmp_radii = None

    def _grows_by_own_steps(self) -> bool:
        """Whether nobody has replaced a step of density control, so that they may be taken together."""
        steps = self.densify_and_clone, self.densify_and_split, self.densification_postfix, self.prune_points
        return tuple(getattr(step, "__func__", None) for step in steps) == _OWN_STEPS

    def _clone_and_split(self, grads: Tensor, grad_threshold: float, scene_extent: float, **how: int) -> Tensor:
        """Append what densify_and_clone and densify_and_split append, in their order, with one copy of all tensors.

        how: seed, iteration and long_axis. Returns the mask (N,) of those that were split; they are left to be removed.
        """
        high = grads >= grad_threshold
        small = rules.is_small(self._log_scales(), self.percent_dense * scene_extent)
        split = high & ~small
        clones, parents = (mask.nonzero().reshape(-1) for mask in (high & small, split))
        origins = torch.cat((clones, parents, parents))
        rows = {name: values.index_select(0, origins) for name, values in raw_rows(self).items()}
        self._make_children(rows, parents, **how)
        self._append(rows, clones, parents, parents)
        return split

    @changes_rows
    def densify_and_clone(self, grads: Tensor, grad_threshold: float, scene_extent: float) -> None:
        """Append an exact copy of each Gaussian with gradient >= threshold and scale <= percent_dense * extent."""
        small = rules.is_small(self._log_scales(), self.percent_dense * scene_extent)
        chosen = ((grads.reshape(-1) >= grad_threshold) & small).nonzero().reshape(-1)
        self._append({name: values.index_select(0, chosen) for name, values in raw_rows(self).items()}, chosen)

    @changes_rows
    def densify_and_split(
        self,
        grads: Tensor,
        grad_threshold: float,
        scene_extent: float,
        N: int = 2,
        *,
        seed: int | None = None,
        iteration: int = 0,
        long_axis: bool = False,
    ) -> None:
        """Replace each Gaussian with gradient >= threshold and scale > percent_dense * extent by N smaller ones.

        grads: (n,) or (n, 1) for the first n Gaussians; those appended since (fresh clones) have gradient 0. seed,
        iteration, long_axis: as in densify_and_prune; ValueError for long_axis unless N is 2.
        """
        if long_axis and N != 2:
            raise ValueError(f"a split along the longest axis makes 2 children, not {N}")
        before = len(self)
        large = ~rules.is_small(self._log_scales(), self.percent_dense * scene_extent)
        grads = grads.reshape(-1)
        large[len(grads) :] = False
        large[: len(grads)] &= grads >= grad_threshold
        parents = large.nonzero().reshape(-1)
        origins = parents.repeat(N)
        rows = {name: values.index_select(0, origins) for name, values in raw_rows(self).items()}
        self._make_children(rows, parents, N, seed, iteration, long_axis)
        self._append(rows, *[parents] * N)
        self.prune_points(torch.cat((large, large.new_zeros(len(self) - before))))

    def _make_children(
        self,
        rows: Rows,
        parents: Tensor,
        count: int = 2,
        seed: int | None = None,
        iteration: int = 0,
        long_axis: bool = False,
    ) -> None:
        """Move and shrink the last rows, which are `count` copies of those of the `parents` (n,), one after another."""
        first = len(rows["xyz"]) - count * len(parents)
        xyz, rotation = (rows[name][first : first + len(parents)] for name in ("xyz", "rotation"))
        shapes = xyz, self._log_scales().index_select(0, parents), rotation
        if long_axis:
            children = long_axis_children(*shapes, self._opacity_logits().index_select(0, parents))
            positions, scales = children["xyz"], children["scaling"]
            rows["opacity"][first:] = self._raw_opacity(children["opacity"])
        else:
            if seed is None:
                seed = self.shards.ranks.shared(int(torch.randint(2**62, ())))
            items = self.shards.items(parents)
            sampled = [
                rules.split_children(*shapes, items, child, count=count, seed=seed, iteration=iteration)
                for child in range(count)
            ]
            positions, scales = (torch.cat(parts) for parts in zip(*sampled, strict=True))
        if not (self.kernels_activate and self.scaling_inverse_activation is torch.log):
            scales = self.scaling_inverse_activation(scales.exp())
        rows["xyz"][first:], rows["scaling"][first:] = positions, scales

    def _append(self, rows: Rows, *origins: Tensor) -> None:
        """Append rows by `densification_postfix`, or what overrides it, with the radii of their origins if set.

        origins: (n,) of the rows of each part, which over all ranks follow each other part by part.
        """
        standard = [rows.pop(name) for name in _STANDARD]
        if self.tmp_radii is not None:
            standard.append(self.tmp_radii.index_select(0, torch.cat(origins)))
        self.densification_postfix(*standard, **rows)
        self.shards.order(*map(self.shards.items, origins))

    @changes_rows
    def densification_postfix(
        self,
        new_xyz: Tensor,
        new_features_dc: Tensor,
        new_features_rest: Tensor,
        new_opacities: Tensor,
        new_scaling: Tensor,
        new_rotation: Tensor,
        new_tmp_radii: Tensor | None = None,
        **new_others: Tensor,
    ) -> None:
        """Append n Gaussians, possibly none, by raw parameters, and zero the statistics of all.

        new_tmp_radii: (n,), appended to `tmp_radii` if that is set; 0 if missing. new_others: further attributes, by
        their names in the table of scene/gaussians/attributes.py.
        """
        standard = new_xyz, new_features_dc, new_features_rest, new_opacities, new_scaling, new_rotation
        self._take(self.cat_tensors_to_optimizer(dict(zip(_STANDARD, standard, strict=True)) | new_others))
        if self.tmp_radii is not None:
            new = self.tmp_radii.new_zeros(len(new_xyz)) if new_tmp_radii is None else new_tmp_radii
            self.tmp_radii = torch.cat((self.tmp_radii, new))
        self.shards.appended(len(new_xyz))
        self._zero_statistics()

    @changes_rows
    def prune_points(self, mask: Tensor) -> None:
        """Remove the Gaussians of a mask, with their optimiser state and statistics.

        IndexError, before anything changes, unless the mask is (N,) bool.
        """
        if mask.dtype != torch.bool or tuple(mask.shape) != (len(self),):
            raise IndexError(
                f"prune_points takes a mask of shape ({len(self)},) and type bool, one value for each Gaussian; "
                f"this one has the shape {tuple(mask.shape)} and type {mask.dtype}"
            )
        kept = ~mask
        keep = kept.nonzero().reshape(-1)
        if len(keep) == len(kept):
            return
        self._take(self._prune_optimizer(kept))
        self.shards.kept(keep)
        for name in (*NAMES, "tmp_radii"):
            values = getattr(self, name, None)  # users delete those that they do not need
            if values is not None:
                setattr(self, name, values.index_select(0, keep))

    def reset_opacity(self) -> None:
        """Lower every opacity to at most 0.01; Adam's averages of it restart at zero."""
        if self.kernels_activate and self.inverse_opacity_activation is inverse_sigmoid:
            lowered = self._opacity.detach().clamp_max(rules.logit(rules.RESET_OPACITY))
        else:
            lowered = self.inverse_opacity_activation(self.get_opacity.detach().clamp_max(rules.RESET_OPACITY))
        self._take(self.replace_tensor_to_optimizer(lowered, "opacity"))

    def _log_scales(self) -> Tensor:
        """Logarithms (N, 3) of the scales, whatever their activation is."""
        return (self._scaling if self.kernels_activate else self.get_scaling.log()).detach()

    def _opacity_logits(self) -> Tensor:
        """Logits (N, 1) of the opacities, whatever their activation is."""
        return (self._opacity if self.kernels_activate else inverse_sigmoid(self.get_opacity)).detach()

    def _raw_opacity(self, logits: Tensor) -> Tensor:
        """Raw values of opacities (n, 1) given by their logits, whatever their activation is."""
        if self.kernels_activate and self.inverse_opacity_activation is inverse_sigmoid:
            return logits
        return self.inverse_opacity_activation(logits.sigmoid())

    # The reference's names for changes of the optimiser's parameters; the model's own attributes stay as they are.

    def replace_tensor_to_optimizer(self, tensor: Tensor, name: str) -> dict[str, nn.Parameter]:
        """Give an optimiser group a new value, without gradient, and averages of zero. Returns its parameter by name.

        Without an optimiser the parameter is made all the same; {} for a name that is not there.
        """
        optimised, others, states = self._groups()
        groups = [group for group in optimised + others if group.get("name") == name]
        return {group["name"]: replace_values(group, states, tensor) for group in groups}

    def cat_tensors_to_optimizer(self, tensors_dict: Rows) -> dict[str, nn.Parameter]:
        """Append rows (n, ...) by group name, with averages of zero. Returns the parameters by name, without gradient.

        Groups that do not have a row per Gaussian stay as they are. ValueError for one that has, but gets no rows.
        """
        groups, others, states = self._groups()
        groups += [group for group in others if self.optimizer is None or group["name"] in tensors_dict]
        counts = [len(group["params"][0]) for group in groups if group.get("name") in tensors_dict]
        return append_rows(row_groups(groups, counts[0] if counts else len(self)), states, tensors_dict)

    def _prune_optimizer(self, mask: Tensor) -> dict[str, nn.Parameter]:
        """Keep the rows of a mask (N,) bool in all groups with N rows. Returns the parameters by name."""
        keep = mask.reshape(-1).nonzero().reshape(-1)
        optimised, others, states = self._groups()
        return keep_rows(row_groups(optimised + others, len(mask)), states, keep)

    def _groups(self) -> tuple[list[Group], list[Group], States]:
        """The optimiser's groups, a group for each attribute that is not optimised, and the optimiser's state."""
        optimised = [] if self.optimizer is None else list(self.optimizer.param_groups)
        names = {group.get("name") for group in optimised}
        others = [
            {"name": name, "params": [getattr(self, attribute.field)]}
            for name, attribute in self._attributes.items()
            if name not in names
        ]
        return optimised, others, {} if self.optimizer is None else self.optimizer.state


def _views(gradient: Tensor, radii: Tensor) -> list[tuple[Tensor, Tensor]]:
    """The gradients and radii of each view."""
    return [(gradient, radii)] if radii.dim() == 1 else list(zip(gradient, radii, strict=True))


# Read once, so that a step is told from one that replaces it, in a subclass or in this class.
_OWN_STEPS = (
    AdaptiveGaussians.densify_and_clone,
    AdaptiveGaussians.densify_and_split,
    AdaptiveGaussians.densification_postfix,
    AdaptiveGaussians.prune_points,
)
