"""The camera of an image, and how to render it."""

from typing import NamedTuple

from torch import Tensor

from diff_gaussian_rasterization.lens import Lens


class GaussianRasterizationSettings(NamedTuple):
    """The camera, and how to render; the first 13 fields are the reference's, in its order.

    Matrices are transposed: they act on row vectors. x points right, y down, z forward; pixel centres lie at integers.
    `projmatrix` is the full projection, view times projection, and contains the principal point.

    viewmatrix, projmatrix, campos and lens_values receive gradients if they require them, and so do tangents given as
    scalar tensors. Each is a partial derivative: a pose has to make all of matrices and centre (scene/poses.py).
    """

    image_height: int
    image_width: int
    tanfovx: float | Tensor  # tan of half the field of view; 0: that of projmatrix
    tanfovy: float | Tensor
    bg: Tensor  # (3,)
    scale_modifier: float
    viewmatrix: Tensor  # (4, 4) world to view, transposed; a rigid motion, or any other invertible map
    projmatrix: Tensor  # (4, 4) world to clip, transposed
    sh_degree: int  # active degree, from 0 on; one above 3 counts as 3
    campos: Tensor  # (3,) world
    prefiltered: bool  # accepted for compatibility; culling does not rely on it
    debug: bool  # check inputs, image and gradients for NaN and Inf; the error names the tensor and the place
    antialiasing: bool | None = None  # None, as in the 12 fields of 2023: off, and GaussianRasterizer has two results
    inverse_depth: bool = True  # False: the third result is None and nothing is computed for it
    lens: Lens | None = None  # in place of a pinhole: then tanfovx, tanfovy and projmatrix are not read
    lens_values: Tensor | None = None  # (15,) in place of those of the lens: Lens.values
    projection: str = "ewa"  # or "ray": a pixel sees a Gaussian along its own ray, not by EWA's affine map
    dilation: float = 0.3  # px^2, 0 to 1: added to both variances on the image, so that a Gaussian covers a pixel
    near: float = 0.2  # Gaussians at or before this depth in the view are left out
