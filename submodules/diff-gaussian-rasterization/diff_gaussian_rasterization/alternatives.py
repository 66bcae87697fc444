"""The inputs of a rendering that may be given in two ways, as the reference's functions take them."""

from torch import Tensor

from diff_gaussian_rasterization.gaussians import Gaussians

MOST_DEGREE = 3
MOST_BANDS = 16  # of degree 3; those above are not read


def given(values: Tensor | None) -> Tensor | None:
    """None for the empty tensor that stands for it; a tensor of no Gaussians has more axes."""
    return None if isinstance(values, Tensor) and values.shape == (0,) else values


def shaped(values: Tensor | None, *shape: int) -> Tensor | None:
    """The same values in another shape where only the axes of length 1 differ, else as they are."""
    if values is None or values.shape == shape or [n for n in values.shape if n != 1] != [n for n in shape if n != 1]:
        return values
    return values.reshape(shape)


def chosen(
    means: Tensor,
    opacities: Tensor,
    scales: Tensor | None,
    rotations: Tensor | None,
    cov3d: Tensor | None,
    colors: Tensor | None,
    sh: Tensor | None,
    dc: Tensor | None = None,
) -> Gaussians:
    """The inputs that count: of two alternatives the precomputed one.

    sh: all bands (N, K, 3), or with dc (N, 1, 3) those above the first. Raises ValueError for sh of another rank.
    """
    scales, rotations, cov3d, colors, sh, dc = map(given, (scales, rotations, cov3d, colors, sh, dc))
    if sh is not None and sh.dim() != 3:
        raise ValueError(f"shs must be (N, K, 3), got {tuple(sh.shape)}")
    count = len(means)
    opacities, colors = shaped(opacities, count, 1), shaped(colors, count, 3)
    if colors is not None or (sh is None and dc is None):
        bands = None, None
    elif dc is not None:
        bands = dc, dc[:, :0] if sh is None else sh
    else:
        bands = sh[:, :1], sh[:, 1:MOST_BANDS]
    if cov3d is not None:
        scales = rotations = None
    return Gaussians(means, opacities, scales, rotations, cov3d, colors, *bands)
