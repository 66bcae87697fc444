"""The order of views where some are new."""

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

from scene.cameras import Camera
from splatting.training.iteration import ViewOrder
from utils.system_utils import UserError


class Added(NamedTuple):
    """Photos that a training got after an iteration, `since`, and until when they train more often."""

    since: int
    until: int
    names: list[str]

    @classmethod
    def at(cls, since: int, last: int | None, names: Collection[str], views: Sequence[Camera]) -> "Added":
        """Until the new ones have trained as often as the others on average, at most half of what is left to `last`.

        last: None where a clock decides it. views: all that train.
        """
        new = sum(view.image_name in names for view in views)
        visits = since / max(len(views) - new, 1)
        count = int(2 * new * visits)
        return cls(since, since + (count if last is None else min(count, (last - since) // 2)), sorted(names))

    @classmethod
    def restored(cls, state: Any) -> "Added":
        """From a checkpoint. UserError if it is broken."""
        try:
            found = cls(**state)
            valid = type(found.since) is type(found.until) is int and all(isinstance(name, str) for name in found.names)
        except TypeError:
            valid = False
        if not valid:
            raise UserError("the checkpoint's record of added photos is damaged; give another checkpoint")
        return found


class _NewFirst(ViewOrder):
    """Every second iteration of a span trains on a new view, and the others on an old one; then all by epochs."""

    def __init__(self, every: ViewOrder, added: Added) -> None:
        super().__init__(every.cameras, every.seed)
        names = {*added.names}
        self._new, self._old = (
            ViewOrder([view for view in every.cameras if (view.image_name in names) is new], every.seed)
            for new in (True, False)
        )
        self._added = added

    def __getitem__(self, iteration: int) -> Camera:
        since, until, _ = self._added
        if not since < iteration <= until:
            return super().__getitem__(iteration)
        turn, old = divmod(iteration - since - 1, 2)
        return (self._old if old else self._new)[turn + 1]

    def coming(self, iteration: int, count: int) -> list[Camera]:
        return list(dict.fromkeys(super().coming(iteration, count)))  # few new ones come again soon


def added_order(every: ViewOrder, added: Added) -> ViewOrder:
    """The order with the new views, if both new and old ones train."""
    names = {*added.names}
    new = sum(view.image_name in names for view in every.cameras)
    return _NewFirst(every, added) if 0 < new < len(every.cameras) else every
