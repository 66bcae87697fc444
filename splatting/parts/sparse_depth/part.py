"""Depth by the points of structure from motion (--sparse_depth): each view's own, where its photo has seen them.

Sparse points as supervision of depth: Deng et al. 2022 (DS-NeRF), section 3. No network is asked.
"""

from typing import TYPE_CHECKING, Any

from splatting.option import Option, at_least
from splatting.part import Needs, Options, Part

if TYPE_CHECKING:
    from splatting.training.iteration import Iteration, Term


class SparseDepth(Part):
    """Adds the depth of a view's points to its loss."""

    name = "sparse_depth"
    tools = ("advise",)
    # fmt: off
    options = Options(optimisation=(
        Option("sparse_depth", 0.0, origin="ours", check=at_least(0), topic="data",
            help="weight of the loss of depth at the scene's own points (COLMAP only); 0: off"),
    ))
    # fmt: on
    needs = Needs(depth=True, ranks=False, files=True)

    def begin(self, run: Any, state: Any) -> None:
        from splatting.parts.sparse_depth.points import SeenPoints

        self._points = SeenPoints(run.scene, run.dataset.source_path, run.opt.sparse_depth)

    def terms(self, at: "Iteration") -> "dict[str, Term]":
        points = self._points.at(at.camera)
        return {"points": lambda package, mask: points.loss(package["depth"], mask)} if points else {}
