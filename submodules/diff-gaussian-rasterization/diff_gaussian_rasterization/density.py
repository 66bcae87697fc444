"""Computations of density control, without its decisions. Nothing here is differentiable."""

import torch
from torch import Tensor

from diff_gaussian_rasterization.backend import OPERATORS

_displace = OPERATORS.displace_
_penalise = OPERATORS.penalise_


def split_positions(
    means: Tensor,
    log_scales: Tensor,
    rotations: Tensor,
    items: Tensor,
    *,
    seed: int,
    stream: int,
    iteration: int,
    draw: int,
) -> Tensor:
    """Centres (n, 3) of one child for each of n split Gaussians: normal about its parent, with the parent's shape.

    means (n, 3), log_scales (n, 3) and rotations (n, 4) wxyz of any length are the parents', float32. items: (n,)
    int64, their indices in the model. The random numbers are a function of seed (its lower 64 bits), stream, iteration,
    item and draw, each of the last four below 2^32. Every device and number of threads gives the same bits.
    """
    children = means.clone(memory_format=torch.contiguous_format)
    _displace(children, log_scales, rotations, None, items, [], _to_signed(seed), stream, iteration, draw)
    return children


def add_noise_(
    means: Tensor,
    log_scales: Tensor,
    rotations: Tensor,
    logits: Tensor,
    *,
    size: float,
    steepness: float,
    threshold: float,
    seed: int,
    stream: int,
    iteration: int,
    stopped: Tensor | None = None,
    first: int = 0,
) -> None:
    """Moves Gaussians at random (Kheradmand et al. 2024): each mean by size g C n.

    C is the covariance (N, 3, 3), n (N, 3) standard normal, g = 1 / (1 + exp(steepness (o - threshold))) with the
    opacity o. means (N, 3), log_scales (N, 3), rotations (N, 4) wxyz of any length and opacity logits (N, 1): float32;
    means are contiguous and change. A mean that would not be finite stays. size is at least 0, steepness from 0 to
    10,000. The random numbers are a function of seed (its lower 64 bits), stream, iteration and the Gaussian's index,
    each of the last three below 2^32; first: the index of the first one. Every device and number of threads gives the
    same bits. stopped: of a guard (optim.py); once it is not 0, nothing changes.
    """
    gate = [size, steepness, threshold]
    _displace(means, log_scales, rotations, logits, None, gate, _to_signed(seed), stream, iteration, 0, stopped, first)


def penalise_(
    logits: Tensor,
    log_scales: Tensor,
    logit_gradients: Tensor,
    log_scale_gradients: Tensor,
    *,
    opacity: float,
    scale: float,
) -> None:
    """Adds the gradients of opacity * sum(sigmoid(logits)) + scale * sum(exp(log_scales)) to those that are given.

    logits and their gradients: (N, 1); log_scales and theirs: (N, 3); all float32, or on the CPU float64. The gradients
    are contiguous and change. `apply_gradients_` adds the same bits.
    """
    _penalise(logits, log_scales, logit_gradients, log_scale_gradients, opacity, scale)


def random_words(items: Tensor, *, seed: int, stream: int, iteration: int, draw: int = 0) -> Tensor:
    """Four random numbers below 2^32 for each of (n,) int64 items below 2^32: (n, 4) int64.

    Philox-4x32-10 (Salmon et al. 2011) of item, draw, iteration and stream, each below 2^32, by the seed's lower 64
    bits. Every device and number of threads gives the same bits.
    """
    return OPERATORS.random_words(items, _to_signed(seed), stream, iteration, draw)


def _to_signed(seed: int) -> int:
    """Return the lower 64 bits of a seed as the operators take them."""
    return (seed + 2**63) % 2**64 - 2**63
