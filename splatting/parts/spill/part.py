"""The limit of what a training takes of a GPU (--gpu_memory): SH bands that do not fit lie in the host's memory.

The limit must begin before the first rows exist, and the most rows of a checkpoint may not fit on the GPU at all. So
the part gives the model its room in `check`, while the model is empty, not in `begin`.
"""

from typing import TYPE_CHECKING, Any

from splatting.option import Option, within
from splatting.part import Error, Options, Part, fill

if TYPE_CHECKING:
    import argparse

    from splatting.training.iteration import Iteration


class Spill(Part):
    """Gives the model its room, says what of it lies on the host, and brings back what fits after a change.

    It is in every training: without the option, a limit begins where a GPU is too small.
    """

    name = "spill"
    switch = "gpu_memory"
    # fmt: off
    options = Options(optimisation=(
        Option("gpu_memory", 0.0, origin="ours", check=within(0, 1_000_000), topic="memory",
            help="GiB of the GPU's memory that training may use, 0: all. SH bands above 0 and their Adam state that do "
                 "not fit are kept in the host's memory; slower, with the same result"),
    ))
    # fmt: on

    @classmethod
    def wanted(cls, given: "argparse.Namespace") -> bool:
        return True

    def check(self, run: Any, state: Any) -> None:
        from splatting.parts.spill.gpu_memory import GpuMemory
        from splatting.parts.spill.torch_limit import release_torch
        from splatting.registry import part_class, strategies

        release_torch()  # from the limit of a training that was refused after this
        self._model = run.gaussians
        absolute = any(part_class(name).takes_absolute(run.opt) for name in strategies())
        fill(self._model, "room", GpuMemory(run.opt.gpu_memory, self._model, absolute, run.device), self)

    def ready(self, run: Any) -> None:
        self._model.room.expect(-(-run.density.max_gaussians // run.group.size), run.scene)

    def opened(self, run: Any) -> None:
        from splatting.parts.spill.announcement import announce

        announce(run, self._model.room)
        self._model.room.settle(self._model)

    def after_change(self, at: "Iteration") -> None:
        self._model.room.settle(self._model)

    def ended(self, error: Error) -> None:
        from splatting.parts.spill.torch_limit import release_torch

        release_torch()
