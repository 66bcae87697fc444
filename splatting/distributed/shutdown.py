"""The end of a training of several ranks: one sentence for all of them, from one of them."""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field

from splatting.distributed import rank_logging
from splatting.distributed.key_value_store import KeyValueStore, is_gone
from splatting.distributed.rank_logging import names
from splatting.host.clock import running_seconds

DONE, FAULT, HANG, SIGNAL, LOST = "done", "fault", "hang", "signal", "lost"
NO_WORD = "error: the ranks lost each other"  # and none says more
_WAIT = 8.0  # seconds for the others to end, too
_SILENT = 6.0  # seconds without a beat (watch.py) after which a rank of another host is taken for gone


@dataclass
class End:
    """How a rank has ended.

    kind: DONE; FAULT, its own; HANG, of another rank, which `line` names; SIGNAL; LOST, by the end of another rank.
    notes: what it has said on stderr.
    """

    kind: str
    status: int
    line: str = ""
    notes: list[str] = field(default_factory=list)


def verdict(ends: Mapping[int, End], gone: Sequence[int], size: int) -> tuple[int, str, int, bool]:
    """Decide from the ends of ranks who speaks, what it says (which may be nothing), and the exit status of all.

    gone: ranks that have left no word. The last of the result is whether a rank was lost, so that what is left has to
    be said.
    """
    faults = {rank: end for rank, end in ends.items() if end.kind == FAULT}
    if faults:
        speaker = min(faults)
        end = faults[speaker]
        alike = len(faults) == size and len({fault.line for fault in faults.values()}) == 1
        line = end.line if alike or not end.line else end.line.replace("error:", f"error: rank {speaker}:", 1)
        return speaker, line, end.status, False
    if gone:
        return min(ends), f"error: {names(gone)} ended without a word (killed, or crashed)", 1, True
    for kind in (HANG, SIGNAL, LOST):
        those = {rank: end for rank, end in ends.items() if end.kind == kind}
        if those:
            speaker = min(those)
            return speaker, those[speaker].line, those[speaker].status, kind in (HANG, LOST)
    return min(ends), "", 0, False


class Ending:
    """This rank's end, which its main thread or its watch begins, whichever is first."""

    def __init__(self, store: KeyValueStore) -> None:
        self._store = store
        self._begun = threading.Lock()
        self.stands: Callable[[], str] = lambda: "start it again"

    def begin(self) -> bool:
        """Whether the caller is the first to end this rank."""
        return self._begun.acquire(blocking=False)

    def finish(self, end: End, store: KeyValueStore | None = None) -> tuple[int, bool]:
        """Tell the others, and see how they end. Returns the exit status, and whether it is this rank that spoke.

        store: that of the calling thread.
        """
        store = store or self._store
        end.notes = rank_logging.take()
        try:
            store.post("end", asdict(end))
            ends, gone = self._others(store, end)
            speaker, line, status, lost = verdict(ends, gone, store.size)
            speaks = speaker == store.rank and status != 0 and store.claim("told")
            tells = speaks if status else store.rank == 0
        except RuntimeError:  # the store is gone, with torchrun
            ends, line, status, lost = {}, end.line or "error: torchrun has ended", end.status or 1, True
            speaks = tells = store.rank == 0
        if tells:
            rank_logging.tell({rank: one.notes for rank, one in ends.items() if rank != store.rank})
        if speaks and line:
            # A progress bar may have been left in its line.
            rank_logging.speak(f"\n{line}; {self.stands()}" if lost else line)
        return status, speaks

    def _others(self, store: KeyValueStore, end: End) -> tuple[dict[int, End], list[int]]:
        """The ends of all ranks that have ended, and those that are gone."""
        before, started = store.read("beat"), running_seconds()
        people = store.read("here")
        while True:
            ends = {rank: End(**one) for rank, one in store.read("end").items()}
            waited = running_seconds() - started
            missing = [rank for rank in range(store.size) if rank not in ends]
            gone = [rank for rank in missing if rank in people and is_gone(people[rank])]
            if waited > _SILENT:
                beats = store.read("beat")
                gone = [rank for rank in missing if rank in gone or beats.get(rank) == before.get(rank)]
            settled = len(gone) == len(missing) or end.kind == DONE and store.rank > 0
            if settled or waited > _WAIT:
                return ends, [] if end.kind == DONE else gone
            time.sleep(0.05)
