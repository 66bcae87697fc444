"""Start and end of train.py as one rank of several, by torch.distributed alone.

torchrun ends all ranks once one has ended with an error, and says which was the first. A rank that waits for another
one in a collective call gives up after TIMEOUT. A rank's uncaught error goes into torchrun's own report (`record`).
"""

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from functools import partialmethod

import torch
import torch.distributed as dist
from torch.distributed.elastic.multiprocessing.errors import record
from tqdm import tqdm

from groundwork.host import torchrun
from groundwork.host.errors import UserError
from groundwork.host.interrupt import let_signals_end
from groundwork.host.machine import compute_device, cores, device_name, instruction_set
from groundwork.host.memory import is_out_of_memory
from groundwork.ranks.process_group import TIMEOUT, SeveralRanks
from groundwork.ranks.ranks import refuse_differences, using

_PRECEDENCE = 2.0  # seconds for rank 0 to end first by an error that all ranks have; torchrun then ends the others
_REFUSED = 2  # exit status
# Of gloo's errors for a rank that is gone or does not answer; NCCL's are DistErrors.
_LOST = ("by peer", "broken pipe", "timed out", "timeout")


@record
def run_together(main: Callable[[], object], outcome: Callable[[Callable[[], object]], tuple[int, str]]) -> int:
    """Run a command as one rank of several; print an error and return the exit status.

    outcome: runs a function and returns its exit status and the message to print; raises errors that it does not know.
    """
    rank = torchrun.rank()
    with contextlib.nullcontext() if rank == 0 else _silence_output():
        try:
            status, line = outcome(lambda: _join_and_run(main))
        except SystemExit as end:  # of argparse, which has said why
            status, line = end.code or 0, ""
        except RuntimeError as error:
            if is_out_of_memory(error) or not _is_lost(error):
                raise
            let_signals_end()  # torchrun sends SIGTERM now; as an exception it would print a traceback
            status, line = 1, "error: another rank has ended, or did not answer in time; see torchrun's report"
    if rank > 0 and status == _REFUSED:
        try:
            time.sleep(_PRECEDENCE)
        except KeyboardInterrupt:  # from torchrun
            return status
    if line and (rank == 0 or status == _REFUSED):
        print(line if rank == 0 else line.replace("error:", f"error: rank {rank}:", 1), file=sys.stderr, flush=True)
    if status and dist.is_initialized() and dist.get_backend() == "nccl":
        sys.stdout.flush()
        os._exit(status)  # Python's own end would wait for kernels that wait for a rank that is gone
    return status


@contextmanager
def _silence_output() -> Iterator[None]:
    """Print nothing and show no progress bar: only rank 0 does."""
    tqdm.__init__ = partialmethod(tqdm.__init__, disable=True)
    with open(os.devnull, "w", encoding="utf-8") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        yield


def _is_lost(error: RuntimeError) -> bool:
    """Tell whether a collective call failed because of another rank."""
    return isinstance(error, dist.DistError) or any(words in str(error).lower() for words in _LOST)


def _join_and_run(main: Callable[[], object]) -> None:
    """Join the group of processes that torchrun has started, and run `main` in it with its ranks."""
    device = _choose_device()
    by_gpu = device.type == "cuda"
    store, rank, size = next(dist.rendezvous("env://", timeout=TIMEOUT))
    # torchrun's store outlives a restart of all ranks, and the notes of those before it are not for these.
    store = dist.PrefixStore(f"restart {torchrun.restarts()}", store)
    options = {"backend": "nccl", "device_id": device} if by_gpu else {"backend": "gloo"}
    os.environ.setdefault("TORCH_NCCL_WAIT_TIMEOUT_DUMP_MILSEC", "1000")  # else a minute more after the limit
    dist.init_process_group(store=store, rank=rank, world_size=size, timeout=TIMEOUT, **options)
    ranks = SeveralRanks()
    refuse_differences(
        ranks.all_gather_objects(_describe_machine(device)), "start all ranks with the same installation"
    )
    with using(ranks):
        main()
    ranks.leave()


def _choose_device() -> torch.device:
    """Choose this rank's device, and make a GPU the current one. Ranks of a host share its cores."""
    device = compute_device()
    if os.environ.get("OMP_NUM_THREADS", "1") == "1":  # which torchrun sets where the user does not
        torch.set_num_threads(cores())
    if device.type == "cuda":
        processes, count = torchrun.local_size(), torch.cuda.device_count()
        if processes > count:
            raise UserError(f"this host has {count} GPUs for {processes} ranks; lower --nproc_per_node to {count}")
        device = torch.device("cuda", torchrun.local_rank())
        torch.cuda.set_device(device)
    return device


def _describe_machine(device: torch.device) -> dict[str, str]:
    facts = {"torch": torch.__version__, "the backend": device.type, "the instruction set": instruction_set()}
    return facts | ({"the GPU": device_name(device)} if device.type == "cuda" else {})
