"""A watch over ranks: it ends this one if another is gone or hangs, and the main thread cannot tell."""

import os
import sys
import threading

from splatting.distributed.key_value_store import KeyValueStore, is_gone
from splatting.distributed.process_group import SeveralRanks
from splatting.distributed.rank_logging import names
from splatting.distributed.shutdown import DONE, HANG, LOST, NO_WORD, End, Ending
from splatting.host.clock import running_seconds

_BEAT = 0.5  # seconds between two beats
_SILENT = 12.0  # seconds without a beat after which a rank is gone
_GRACE = 6.0  # seconds for the main thread to end by itself, as it does where a collective call fails
_GRACE_AT_WORK = 20.0  # if it is writing
_GRACE_HANGING = 1.0  # if others have seen that a rank hangs, perhaps this one
_PATIENCE_FOR_STORE = 2.0  # seconds for an answer of the store
PATIENCE = 15.0  # seconds in a collective call of a step that another rank does not come to, at least
_MULTIPLE = 10  # of the longest such call so far, for steps that take as long


class Watch(threading.Thread):
    """Beats, and looks at the beats of others, as a thread; `ranks` is set once they are joined."""

    def __init__(self, rank: int, size: int, ending: Ending) -> None:
        super().__init__(name="watch over ranks", daemon=True)
        self._store, self._ending = KeyValueStore(rank, size), ending
        self._over = threading.Event()
        self.ranks: SeveralRanks | None = None
        self._number = 0
        self._seen: dict[int, tuple[int, float]] = {}  # by rank: the number of its last beat, and when it came
        self._fault_since: float | None = None
        self.beat()

    def beat(self) -> None:
        """Leave a note of what this rank does."""
        ranks = self.ranks
        self._number += 1
        self._store.post("beat", [self._number, ranks.calls if ranks else 0, bool(ranks and ranks.expected)])

    def run(self) -> None:
        """Look until `leave`."""
        before = running_seconds()
        while not self._over.wait(_BEAT):
            try:
                self.beat()
                end = self._look(running_seconds() - before)
            except RuntimeError:
                end = End(LOST, 1, "error: torchrun has ended")
            if end is not None:
                self._end(end)
            before = running_seconds()

    def leave(self) -> bool:
        """End this thread. Whether it has ended: Python may not end before it, as that would abort the process."""
        self._over.set()
        self.join(_PATIENCE_FOR_STORE)
        return not self.is_alive()

    def _look(self, took: float) -> End | None:
        """How this rank has to end, if the main thread does not see to it. took: seconds that the store has taken."""
        # Seconds in which this process ran: one that was stopped, as all ranks may have been, has waited for nobody.
        now, beats = running_seconds(), self._store.read("beat")
        for rank, (number, _, _) in beats.items():
            if self._seen.get(rank, (0, 0.0))[0] != number or took > _SILENT / 2:  # no rank could leave a note
                self._seen[rank] = number, now
        ends = self._store.read("end")
        people = self._store.read("here")
        gone = [
            rank
            for rank in range(self._store.size)
            if rank not in ends
            and (rank in people and is_gone(people[rank]) or rank in beats and now - self._seen[rank][1] > _SILENT)
        ]
        if gone or any(end["kind"] != DONE for end in ends.values()):
            self._fault_since = self._fault_since or now
            return End(LOST, 1, NO_WORD) if now - self._fault_since > self._grace(ends) else None
        return self._hang(now, beats)

    def _grace(self, ends: dict[int, dict]) -> float:
        if any(end["kind"] == HANG for end in ends.values()):
            return _GRACE_HANGING
        return _GRACE_AT_WORK if self.ranks and self.ranks.prompt and not self.ranks.expected else _GRACE

    def _hang(self, now: float, beats: dict[int, list]) -> End | None:
        ranks = self.ranks
        since = ranks.waiting_since if ranks else None
        if since is None or now - since < max(PATIENCE, _MULTIPLE * ranks.longest):
            return None
        late = [rank for rank, (_, calls, expected) in beats.items() if calls < ranks.calls and expected]
        if not late:
            return None
        line = f"error: {names(late)} hung: the others waited {now - since:.0f} seconds for it in a step"
        return End(HANG, 1, line)

    def _end(self, end: End) -> None:
        if not self._ending.begin():
            return
        status, _ = self._ending.finish(end, self._store)
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(status)
