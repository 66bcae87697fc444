"""Iterations at which a run scores and saves, and where it starts."""

from collections.abc import Sequence
from typing import NamedTuple

from viewing.options import Address


class Plan(NamedTuple):
    """The user's requests for a run, besides training itself. Iterations: of the schedule (training/pacing)."""

    test: Sequence[int]  # -1: none
    save: Sequence[int]  # the PLY; -1: none
    checkpoint: Sequence[int]
    start: str | None  # a chkpntN.pth to resume, None: the dataset's points
    debug_from: int  # pipe.debug is switched on after this iteration; -1: never
    record_curve: bool  # error_vs_time.csv, if there are test views
    plain_step: bool = False  # take every step by autograd, and wait for the GPU in it
    viewer: Address | None = None  # of the web page; None: no page
    parallel: str = "tiles"  # how several ranks share the work: the tiles of each view, or "views"
