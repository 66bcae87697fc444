"""Names of the reference's GaussianModel for what ours has by other names."""

from typing import Any

from torch import Tensor, nn

from scene.gaussians.attributes import Rows


def _delegate(name: str, doc: str) -> property:
    """A part of a model's exposures, by the reference's name."""
    return property(
        lambda self: getattr(self.exposures, name), lambda self, value: setattr(self.exposures, name, value), doc=doc
    )


class ReferenceNames:
    """Changes of the optimiser's parameters, and the parts of the exposures. For GaussianModel."""

    table: Any
    exposures: Any

    _exposure = _delegate("values", "Maps of colours (n, 3, 4) of the n training photos.")
    exposure_mapping = _delegate("mapping", "Index in `get_exposure` by the photo's name.")
    pretrained_exposures = _delegate("pretrained", "Maps (3, 4) by name that replace the trained ones, or None.")
    exposure_optimizer = _delegate("optimizer", "The optimiser of the exposures; None before training is set up.")
    exposure_scheduler_args = _delegate("schedule", "Learning rate by iteration; None before training is set up.")

    @property
    def get_exposure(self) -> Tensor:
        """Maps of colours (n, 3, 4) of the n training photos."""
        return self._exposure

    def get_exposure_from_name(self, image_name: str) -> Tensor:
        """Map of colours (3, 4) of a training photo, by its name in exposure.json."""
        return self.exposures[image_name]

    # The reference's names for changes of the optimiser's parameters; the model's own attributes stay as they are.

    def replace_tensor_to_optimizer(self, tensor: Tensor, name: str) -> dict[str, nn.Parameter]:
        """Give a parameter a new value and averages of zero (GaussianTable.replace)."""
        return self.table.replace(name, tensor)

    def cat_tensors_to_optimizer(self, tensors_dict: Rows) -> dict[str, nn.Parameter]:
        """Append rows (n, ...) by group name, with averages of zero (GaussianTable.append)."""
        return self.table.append(tensors_dict)

    def _prune_optimizer(self, mask: Tensor) -> dict[str, nn.Parameter]:
        """Keep the rows of a mask (N,) bool (GaussianTable.select)."""
        return self.table.select(mask.reshape(-1).nonzero().reshape(-1), mask.numel())
