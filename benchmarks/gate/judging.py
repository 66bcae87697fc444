"""Judgement of the gate: for each scene and quantity what was stored, what was found and what is allowed."""

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import NamedTuple

DEVIATIONS = 3  # of single trainings over the stored seeds
MOST_TIME = 1.10  # seconds of this code over those of the stored build
HEADER = ["scene", "quantity", "stored", "found", "change", "allowed", ""]


class Quantity(NamedTuple):
    """A number of a training. least: the smallest deviation to reckon with, since few seeds can agree by chance."""

    name: str
    worse: int  # 1: more is worse, -1: less is worse
    least: float
    relative: bool  # `least` is a share of the stored mean
    digits: int


QUANTITIES = (
    Quantity("PSNR", -1, 0.02, False, 3),  # dB
    Quantity("SSIM", -1, 0.0003, False, 5),
    Quantity("Gaussians", 1, 0.002, True, 0),
    Quantity("bytes", 1, 0.002, True, 0),  # of the PLY
)


class Row(NamedTuple):
    """A quantity of a scene. change: above 0 is worse."""

    scene: str
    name: str
    stored: float
    found: float
    change: float
    allowed: float
    digits: int

    @property
    def passed(self) -> bool:
        """Whether the change is allowed; False where a number is not finite."""
        return self.change <= self.allowed

    def cells(self) -> list[str]:
        """Return the cells of the table, in the order of HEADER."""
        numbers = (f"{value:,.{self.digits}f}" for value in (self.stored, self.found))
        moved = f"{self.found - self.stored:+,.{self.digits}f}", f"{self.allowed:,.{self.digits}f}"
        return [self.scene, self.name, *numbers, *moved, "" if self.passed else "WORSE"]


def judge_quality(scene: str, stored: Sequence[Mapping], found: Sequence[Mapping]) -> list[Row]:
    """Compare the means of a scene's trainings. stored: two or more seeds; found: one or more."""
    rows = []
    for name, worse, least, relative, digits in QUANTITIES:
        before, now = [run[name] for run in stored], [run[name] for run in found]
        mean = statistics.mean(before)
        deviation = max(statistics.stdev(before), least * mean if relative else least)
        change = worse * (statistics.mean(now) - mean)
        rows.append(Row(scene, name, mean, statistics.mean(now), change, DEVIATIONS * deviation, digits))
    return rows


def judge_time(scene: str, pairs: Sequence[tuple[float, float]]) -> Row:
    """Compare seconds of this code and of the stored build, one pair for each seed, by their mean ratio."""
    ratio = math.exp(statistics.mean(math.log(now / before) for now, before in pairs))
    return Row(scene, "seconds, ratio", 1.0, ratio, ratio - 1, MOST_TIME - 1, 3)
