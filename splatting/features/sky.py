"""A sky behind all points (--sky): Gaussians on a far sphere that stay there."""

import argparse
from collections.abc import Iterator, Sequence
from typing import Any

from torch import Tensor

from groundwork.finding import Finding, note
from scene.readers.tracks import PhotoPoints
from scene.scene import Scene
from splatting.features.sky_shell import FEWEST, Shell, find_sky, resumed_shell, said_of_sky, with_shell
from splatting.iteration import Iteration, Term
from splatting.part import Needs, Part


class Sky(Part):
    """Adds the sky's Gaussians at the start, holds them on their sphere, and keeps the space before them empty."""

    name = "sky"
    needs = Needs(depth=True, ranks=False)
    against = {"strategy=mcmc": "which relocates large Gaussians; use adc or budget"}
    shell = None

    @classmethod
    def asked_by(cls, given: argparse.Namespace) -> str:
        return "--sky" if getattr(given, "sky", "off") != "off" else ""

    @classmethod
    def joins_by_state(cls, given: argparse.Namespace, iteration: int) -> bool:
        return True

    def begin(self, run: Any, state: Any) -> None:
        """Add a sky to a new training, or take that of the checkpoint, and keep density control off its Gaussians."""
        self._run = run
        if state is not None:
            self.shell = resumed_shell(state, run.scene)
        elif run.start:
            print("--sky auto has no effect: the checkpoint has no sky, and only new trainings add one")
        else:
            self.shell = with_shell(run.scene, run.gaussians)
        self.active = self.shell is not None
        if self.active:
            run.gaussians.fixed = self.shell.rows

    def terms(self, at: Iteration) -> dict[str, Term]:
        points = self.shell.at(at.camera, self._run.scene)
        return {"sky": lambda package, mask: points.loss(package["depth"], mask)} if points else {}

    def after_step(self, at: Iteration) -> None:
        if at.changes:
            self.shell.hold(self._run.gaussians)

    def state(self) -> dict[str, Any]:
        return self.shell.captured()

    def facts(self) -> dict[str, Any]:
        return {self.name: self.shell.captured()}

    @staticmethod
    def advise(scene: Scene, tracks: Sequence[PhotoPoints | None]) -> Iterator[Finding]:
        """Measure whether the photos show a sky."""
        if len(scene.info.point_cloud.points):
            _, share = find_sky(scene, Shell.around(scene.info))
            yield note(said_of_sky(share), "--sky auto" if share >= FEWEST else "")

    @staticmethod
    def backdrop(facts: dict[str, Any], means: Tensor) -> Tensor | None:
        """Return a mask of the Gaussians that are far away, large and opaque by intent; None: there is no sky."""
        state = facts.get("sky")
        return Shell.restored(state).rows(means) if state else None
