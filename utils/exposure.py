"""How a trained exposure changes an image."""

from torch import Tensor


def apply_exposure(image: Tensor, exposure: Tensor) -> Tensor:
    """Map the colours c of an image (3, H, W) to c A + b, for an exposure (3, 4) = [A | b] and c as a row vector.

    Differentiable in both. Plain products and sums of planes: a matrix product's rounding may depend on the number of
    threads, and so may its gradient's.
    """
    red, green, blue = (image[i] * exposure[i, :3, None, None] for i in range(3))
    return red + green + blue + exposure[:, 3, None, None]
