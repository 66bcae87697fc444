"""A command that several ranks run together, started by torchrun: joining, and ending with one sentence."""

import os
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NoReturn

import torch
import torch.distributed as dist

from splatting.distributed import rank_logging
from splatting.distributed.key_value_store import KeyValueStore, here
from splatting.distributed.process_group import TIMEOUT, RankLost, SeveralRanks
from splatting.distributed.ranks import refuse_differences, using
from splatting.distributed.shutdown import DONE, FAULT, LOST, NO_WORD, SIGNAL, End, Ending
from splatting.distributed.watchdog import Watch
from splatting.host import interrupt, torchrun
from splatting.host.errors import UserError, first_line
from splatting.host.machine import compute_device, cores, device_name, instruction_set

_SIGNALS = (130, 143)  # exit statuses


def run_together(main: Callable[[], object], outcome: Callable[[Callable[[], object]], tuple[int, str]]) -> int:
    """Run a command as one rank of several. Returns its exit status; one rank has printed why, if it is not 0.

    outcome: runs a function, and gives its exit status and what there is to say of it. An error that it does not know
    is raised again on the rank that tells of it.
    """
    rank, size = torchrun.rank(), torchrun.size()
    rank_logging.hush(rank == 0)
    try:
        store = KeyValueStore(rank, size)
    except UserError as error:
        rank_logging.speak(f"error: rank {rank}: {error}")
        return 2
    ending = Ending(store)
    watch = Watch(rank, size, ending)
    store.post("here", here())
    watch.start()
    end = error = None
    try:
        end, error = _ended(lambda: outcome(lambda: _join_and_run(main, store, watch, ending)))
        interrupt.ignore()
    except KeyboardInterrupt:  # torchrun ends the others when one has ended, also where that was being told
        interrupt.ignore()
        end = end or _end_of(143, "terminated")
    if not ending.begin():
        threading.Event().wait()  # the watch ends this process
    if watch.ranks:
        watch.ranks.leave(end.kind == DONE)
    status, spoke = ending.finish(end)
    at_once = not watch.leave() or status and watch.ranks and watch.ranks.by_gpu
    if error is not None and spoke:
        rank_logging.unhush()
        if not at_once:
            raise error
        traceback.print_exception(error)
    if at_once:
        _leave_at_once(status)
    return status


def _leave_at_once(status: int) -> NoReturn:
    """End without Python's own end, which would wait for kernels of NCCL that wait for a rank that is gone, and abort
    if the watch still waits for the store."""
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(status)


def _ended(run: Callable[[], tuple[int, str]]) -> tuple[End, BaseException | None]:
    """How a command ends, and an error that nobody knows."""
    try:
        return _end_of(*run()), None
    except RankLost:
        return End(LOST, 1, NO_WORD), None
    except SystemExit as exit_:  # of argparse, which has said why
        return End(FAULT if exit_.code else DONE, exit_.code or 0), None
    except Exception as bug:
        return End(FAULT, 1, f"error: {type(bug).__name__}: {first_line(bug)}"), bug


def _end_of(status: int, line: str) -> End:
    kind = DONE if status == 0 else SIGNAL if status in _SIGNALS else FAULT
    return End(kind, status, line)


def _join_and_run(main: Callable[[], object], store: KeyValueStore, watch: Watch, ending: Ending) -> None:
    with _joined(store) as ranks, using(ranks):
        watch.ranks = ranks
        ending.stands = lambda: ranks.stands()
        main()


@contextmanager
def _joined(store: KeyValueStore) -> Iterator[SeveralRanks]:
    """Make the process group: NCCL on GPUs, one a rank, and gloo on CPUs."""
    device = _own_device()
    store.post("machine", _machine(device))
    refuse_differences(store.everyone("machine"), "start all ranks with the same installation")
    options = {"device_id": device} if device.type == "cuda" else {}
    backend = "nccl" if device.type == "cuda" else "gloo"
    # NCCL's own watchdog would abort this process as soon as another is gone, before anybody has said which.
    os.environ.setdefault("TORCH_NCCL_ASYNC_ERROR_HANDLING", "0")
    dist.init_process_group(
        backend,
        store=dist.PrefixStore("group", store.raw),
        rank=store.rank,
        world_size=store.size,
        timeout=TIMEOUT,
        **options,
    )
    yield SeveralRanks()


def _own_device() -> torch.device:
    """The device of this rank, on GPUs the current one from now on. The ranks of a host share its cores."""
    device = compute_device()
    if os.environ.get("OMP_NUM_THREADS", "1") == "1":  # which torchrun sets where the user does not
        torch.set_num_threads(cores())
    if device.type == "cuda":
        number, count = torchrun.local_rank(), torch.cuda.device_count()
        if number >= count:
            raise UserError(f"there is no GPU for it, as this host has {count}; lower --nproc_per_node to {count}")
        torch.cuda.set_device(number)
        return torch.device("cuda", number)
    return device


def _machine(device: torch.device) -> dict[str, str]:
    facts = {"torch": torch.__version__, "the backend": device.type, "the instruction set": instruction_set()}
    return facts | ({"the GPU": device_name(device)} if device.type == "cuda" else {})
