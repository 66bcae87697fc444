"""The exposures of a model, by the reference's names."""

from collections.abc import Callable
from functools import cached_property

import torch
from torch import Tensor

from scene.gaussians.exposure import Exposures


class Exposed:
    """A model with `exposures`, whose parts can be read and replaced by the reference's names, too."""

    @cached_property
    def exposures(self) -> Exposures:
        """Maps of colours of the training photos, identities unless trained."""
        return Exposures()

    @property
    def get_exposure(self) -> Tensor:
        """Maps of colours (n, 3, 4) of the n training photos."""
        return self._exposure

    def get_exposure_from_name(self, image_name: str) -> Tensor:
        """Map of colours (3, 4) of a training photo, by its name in exposure.json."""
        return self.exposures[image_name]

    @property
    def _exposure(self) -> Tensor:
        return self.exposures.values

    @_exposure.setter
    def _exposure(self, values: Tensor) -> None:
        self.exposures.values = values

    @property
    def exposure_mapping(self) -> dict[str, int]:
        """Index in `get_exposure` by the photo's name."""
        return self.exposures.mapping

    @exposure_mapping.setter
    def exposure_mapping(self, mapping: dict[str, int]) -> None:
        self.exposures.mapping = mapping

    @property
    def pretrained_exposures(self) -> dict[str, Tensor] | None:
        """Maps (3, 4) by name that are used in place of the trained ones, or None."""
        return self.exposures.pretrained

    @pretrained_exposures.setter
    def pretrained_exposures(self, maps: dict[str, Tensor] | None) -> None:
        self.exposures.pretrained = maps

    @property
    def exposure_optimizer(self) -> torch.optim.Optimizer | None:
        """The optimiser of the exposures; None before training is set up."""
        return self.exposures.optimizer

    @exposure_optimizer.setter
    def exposure_optimizer(self, optimizer: torch.optim.Optimizer | None) -> None:
        self.exposures.optimizer = optimizer

    @property
    def exposure_scheduler_args(self) -> Callable[[int], float] | None:
        """The learning rate of the exposures by iteration; None before training is set up."""
        return self.exposures.schedule

    @exposure_scheduler_args.setter
    def exposure_scheduler_args(self, schedule: Callable[[int], float] | None) -> None:
        self.exposures.schedule = schedule
