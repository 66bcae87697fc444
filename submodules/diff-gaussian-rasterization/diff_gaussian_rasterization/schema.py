"""Names and order of the operators' inputs and gradients, read from the operators' own schemas."""

from diff_gaussian_rasterization.backend import OPERATORS

_PROJECT = OPERATORS.project.default._schema
_RASTERIZE = OPERATORS.rasterize.default._schema
_RASTERIZE_VJP = OPERATORS.rasterize_vjp.default._schema

# The Gaussians and the camera, as most operators take them: first tensors, some of which may be None, then numbers.
SCENE = tuple(argument.name for argument in _PROJECT.arguments)
SCENE_TENSORS = sum("Tensor" in str(argument.type) for argument in _PROJECT.arguments)

# Inputs of `rasterize`, and those of them that receive gradients, in the order of `wanted` of `rasterize_vjp`.
INPUTS = tuple(argument.name for argument in _RASTERIZE.arguments)
GRADIENTS = tuple(result.name for result in _RASTERIZE_VJP.returns)
GRADIENT_PLACES = tuple(INPUTS.index(name) for name in GRADIENTS)
