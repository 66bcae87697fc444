"""Adaptive density control (Kerbl et al. 2023, section 5.2): statistics, clones, splits, removal, resets.

Functions of a GaussianModel, which has them as its methods.
"""

import torch
from torch import Tensor

from groundwork.ranks.rows import changes_rows
from scene.gaussians import density_rules as rules
from scene.gaussians.attributes import Rows
from scene.gaussians.parameters import GaussianParameters
from scene.gaussians.statistics import PER_ROW
from utils.system_utils import UserError

_STANDARD = ("xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation")  # the order of densification_postfix


def observe(gaussians: GaussianParameters, viewspace_points: Tensor, radii: Tensor) -> None:
    """Add a view to the statistics: largest radius, gradient length and count of the Gaussians it saw.

    viewspace_points: (N, 3) with `.grad` per NDC unit; radii: (N,) int32 pixels, 0 where not seen. One pass updates
    max_radii2D and does the work of add_densification_stats for radii > 0.
    """
    gaussians.statistics.observe(viewspace_points.grad, radii)


def observe_absolute(gaussians: GaussianParameters, viewspace_points: Tensor, radii: Tensor) -> None:
    """Do as observe with the lengths of absolute gradients, of a `render` with want_absolute_gradient."""
    gaussians.statistics.observe(viewspace_points.grad[:, 2], radii)


def add_densification_stats(
    gaussians: GaussianParameters, viewspace_point_tensor: Tensor, update_filter: Tensor
) -> None:
    """Add this view's screen-space gradient lengths and count it, for the Gaussians it saw.

    viewspace_point_tensor: (N, 3) with `.grad` per NDC unit; update_filter: indices (n,) or (n, 1), or a mask (N,).
    """
    gaussians.statistics.add_gradient(viewspace_point_tensor.grad, update_filter)


@changes_rows
def densify_and_prune(
    gaussians: GaussianParameters,
    max_grad: float,
    min_opacity: float,
    extent: float,
    max_screen_size: int | None,
    radii: Tensor | None = None,
    *,
    seed: int | None = None,
    iteration: int = 0,
    max_splats: int = 0,
) -> None:
    """Clone small and split large Gaussians with a mean gradient >= max_grad, then remove useless ones.

    min_opacity: a Gaussian below it is removed. extent: of the scene, world units. max_screen_size: pixels; unless
    None, Gaussians wider than that or than a tenth of the extent are removed, except fixed ones.
    radii: (N,) pixels of this view, `tmp_radii` until the end. seed and iteration decide the positions of split
    children; without a seed, torch's generator draws one. max_splats > 0 bounds the number of Gaussians.
    """
    if radii is not None:
        gaussians.tmp_radii = radii
    for attribute in gaussians._attributes.values():  # frees memory; the new parameters have no gradient anyway
        getattr(gaussians, attribute.field).grad = None
    gradient = rules.mean_gradient(gaussians.xyz_gradient_accum, gaussians.denom)
    if max_splats > 0:
        most = max_splats - gaussians.gaussian_count
        gradient = rules.limit_growth(gradient, max_grad, most, gaussians.shards)
    how = {} if seed is None else {"seed": seed, "iteration": iteration}
    split = None
    if _grows_by_own_steps(gaussians):
        split = _clone_and_split(gaussians, gradient, max_grad, extent, **how)
    else:
        column = gradient.unsqueeze(1)  # (N, 1) as in the reference, since overriding code takes norms of its rows
        gaussians.densify_and_clone(column, max_grad, extent)
        gaussians.densify_and_split(column, max_grad, extent, **how)
    remove = rules.is_useless(gaussians.opacity_logits(), min_opacity)
    if split is not None:
        remove[: len(split)] |= split
    if max_screen_size:
        # Appending has just zeroed max_radii2D, so the first test never fires, as in the reference.
        remove |= gaussians.max_radii2D > max_screen_size
        large = ~rules.is_small(gaussians.log_scales(), rules.PRUNE_EXTENT * extent)
        remove |= large if gaussians.fixed is None else large & ~gaussians.fixed(gaussians.raw("xyz"))
    gaussians.prune_points(remove)
    if radii is not None:
        gaussians.tmp_radii = None


def _grows_by_own_steps(gaussians: GaussianParameters) -> bool:
    """Tell whether all steps of density control are ours, so that they may be taken together."""
    own = densify_and_clone, densify_and_split, densification_postfix, prune_points
    return all(getattr(getattr(gaussians, step.__name__), "__func__", None) is step for step in own)


def _clone_and_split(
    gaussians: GaussianParameters, grads: Tensor, grad_threshold: float, scene_extent: float, **how: int
) -> Tensor:
    """Append what densify_and_clone and densify_and_split append, in their order, with one copy of all tensors.

    how: seed and iteration. Returns the mask (N,) of those that were split; they are left to be removed.
    """
    high = grads >= grad_threshold
    small = rules.is_small(gaussians.log_scales(), gaussians.percent_dense * scene_extent)
    split = high & ~small
    clones, parents = (mask.nonzero().reshape(-1) for mask in (high & small, split))
    origins = torch.cat((clones, parents, parents))
    rows = gaussians.rows_at(origins)
    _make_children(gaussians, rows, parents, **how)
    append_rows(gaussians, rows, clones, parents, parents)
    return split


@changes_rows
def densify_and_clone(gaussians: GaussianParameters, grads: Tensor, grad_threshold: float, scene_extent: float) -> None:
    """Append an exact copy of each Gaussian with gradient >= threshold and scale <= percent_dense * extent."""
    small = rules.is_small(gaussians.log_scales(), gaussians.percent_dense * scene_extent)
    chosen = ((grads.reshape(-1) >= grad_threshold) & small).nonzero().reshape(-1)
    append_rows(gaussians, gaussians.rows_at(chosen), chosen)


@changes_rows
def densify_and_split(
    gaussians: GaussianParameters,
    grads: Tensor,
    grad_threshold: float,
    scene_extent: float,
    N: int = 2,
    *,
    seed: int | None = None,
    iteration: int = 0,
) -> None:
    """Replace each Gaussian with gradient >= threshold and scale > percent_dense * extent by N smaller ones.

    grads: (n,) or (n, 1) for the first n Gaussians; those appended since (fresh clones) have gradient 0. seed
    and iteration as in densify_and_prune.
    """
    before = len(gaussians)
    large = ~rules.is_small(gaussians.log_scales(), gaussians.percent_dense * scene_extent)
    grads = grads.reshape(-1)
    large[len(grads) :] = False
    large[: len(grads)] &= grads >= grad_threshold
    parents = large.nonzero().reshape(-1)
    origins = parents.repeat(N)
    rows = gaussians.rows_at(origins)
    _make_children(gaussians, rows, parents, N, seed, iteration)
    append_rows(gaussians, rows, *[parents] * N)
    gaussians.prune_points(torch.cat((large, large.new_zeros(len(gaussians) - before))))


def _make_children(
    gaussians: GaussianParameters,
    rows: Rows,
    parents: Tensor,
    count: int = 2,
    seed: int | None = None,
    iteration: int = 0,
) -> None:
    """Move and shrink the last rows, which are `count` copies of those of the `parents` (n,), one after another."""
    first = len(rows["xyz"]) - count * len(parents)
    xyz, rotation = (rows[name][first : first + len(parents)] for name in ("xyz", "rotation"))
    shapes = xyz, gaussians.log_scales().index_select(0, parents), rotation
    if seed is None:
        seed = gaussians.shards.ranks.broadcast_object(int(torch.randint(2**62, ())))
    items = gaussians.shards.global_indices(parents)
    sampled = [
        rules.split_children(*shapes, items, child, count=count, seed=seed, iteration=iteration)
        for child in range(count)
    ]
    positions, scales = (torch.cat(parts) for parts in zip(*sampled, strict=True))
    rows["xyz"][first:], rows["scaling"][first:] = positions, gaussians.raw_scaling(scales)


def append_rows(gaussians: GaussianParameters, rows: Rows, *origins: Tensor) -> None:
    """Append rows by `densification_postfix`, or what overrides it, with the radii of their origins if set.

    origins: (n,) of the rows of each part, which follow each other part by part over all processes.
    """
    standard = [rows.pop(name) for name in _STANDARD]
    if gaussians.tmp_radii is not None:
        standard.append(gaussians.tmp_radii.index_select(0, torch.cat(origins)))
    gaussians.densification_postfix(*standard, **rows)
    gaussians.shards.order_appended(*map(gaussians.shards.global_indices, origins))


@changes_rows
def densification_postfix(
    gaussians: GaussianParameters,
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
    gaussians._take(gaussians.cat_tensors_to_optimizer(dict(zip(_STANDARD, standard, strict=True)) | new_others))
    if gaussians.tmp_radii is not None:
        new = gaussians.tmp_radii.new_zeros(len(new_xyz)) if new_tmp_radii is None else new_tmp_radii
        gaussians.tmp_radii = torch.cat((gaussians.tmp_radii, new))
    gaussians.shards.note_appended(len(new_xyz))
    gaussians._zero_statistics()


@changes_rows
def prune_points(gaussians: GaussianParameters, mask: Tensor) -> None:
    """Remove the Gaussians of a mask, with their optimiser state and statistics.

    IndexError, before anything changes, unless the mask is (N,) bool.
    """
    if mask.dtype != torch.bool or tuple(mask.shape) != (len(gaussians),):
        raise IndexError(
            f"prune_points takes a mask of shape ({len(gaussians)},) and type bool, one value for each Gaussian; "
            f"this one has the shape {tuple(mask.shape)} and type {mask.dtype}"
        )
    kept = ~mask
    keep = kept.nonzero().reshape(-1)
    if len(keep) == len(kept):
        return
    gaussians._take(gaussians._prune_optimizer(kept))
    gaussians.shards.note_kept(keep)
    for name in PER_ROW:
        values = getattr(gaussians, name, None)  # users delete those that they do not need
        if values is not None:
            setattr(gaussians, name, values.index_select(0, keep))
    for name, values in gaussians.columns.items():
        gaussians.columns[name] = values.index_select(0, keep)


@changes_rows
def remove_useless(gaussians: GaussianParameters, min_opacity: float, most: int) -> None:
    """Remove Gaussians of an opacity below min_opacity; then those of the lowest, until there are at most `most`."""
    opacity = gaussians.opacity_logits().reshape(-1)
    remove = rules.is_useless(opacity, min_opacity)
    over = gaussians.gaussian_count - most
    if over > 0:
        remove[gaussians.shards.lowest(opacity, over)] = True
    gaussians.prune_points(remove)


def refuse_empty(iteration: int, is_empty: bool, remedy: str, what: str = "after the densification of") -> None:
    """UserError if density control has left no Gaussian."""
    if is_empty:
        raise UserError(
            f"no Gaussian was left {what} iteration {iteration}: the views do not agree with the points, or show "
            f"nothing but the background; check the scene, or {remedy}"
        )


def reset_opacity(gaussians: GaussianParameters) -> None:
    """Lower every opacity to at most 0.01; Adam's averages of it restart at zero."""
    if gaussians.keeps_logits:
        lowered = gaussians._opacity.detach().clamp_max(rules.logit(rules.RESET_OPACITY))
    else:
        lowered = gaussians.inverse_opacity_activation(gaussians.get_opacity.detach().clamp_max(rules.RESET_OPACITY))
    gaussians._take(gaussians.replace_tensor_to_optimizer(lowered, "opacity"))
