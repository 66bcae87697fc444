"""Runs a function of the tests in several processes that train together (gloo, on the CPU)."""

import os
import socket
from collections.abc import Callable
from typing import Any

import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from torch.multiprocessing.spawn import start_processes

from splatting.distributed.process_group import SeveralRanks
from splatting.distributed.ranks import using


def in_ranks(size: int, function: Callable[..., Any], *args: Any) -> list[Any]:
    """Call function(*args) in `size` new processes, within `using` their ranks; its results, in the order of ranks.

    The function must be at the top level of a module, and its result must pickle. An error of one is raised here.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    # One process imports torch and the code; the others are its forks.
    mp.get_context("forkserver").set_forkserver_preload(["train", "splatting.distributed.process_group"])
    with mp.get_context("forkserver").Manager() as manager:
        results = manager.dict()
        start_processes(_run, (size, port, function, args, results), nprocs=size, start_method="forkserver")
        return [results[rank] for rank in range(size)]


def _run(rank: int, size: int, port: int, function: Callable[..., Any], args: tuple, results: dict) -> None:
    torch.set_num_threads(1)
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "GLOO_SOCKET_IFNAME": "lo"}
    dist.init_process_group("gloo", rank=rank, world_size=size)
    try:
        with using(SeveralRanks()):
            results[rank] = function(*args)
    finally:
        dist.destroy_process_group()
