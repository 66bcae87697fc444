"""Runs functions of the tests in several processes that train together (gloo, on the CPU).

The processes are kept for later calls: to start them takes longer than most of what is run in them.
"""

import os
import pickle
import socket
import sys
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection, wait
from typing import Any

import torch
import torch.distributed as dist
import torch.multiprocessing as mp

from groundwork.ranks.process_group import SeveralRanks
from groundwork.ranks.ranks import using

_kept: dict[int, "_Group"] = {}  # by number of processes


def in_ranks(size: int, function: Callable[..., Any], *args: Any) -> list[Any]:
    """Call function(*args) in `size` processes, within `using` their ranks; its results, in the order of ranks.

    The function must be at the top level of a module, and its result must pickle. An error of one is raised here.
    """
    group = _kept[size] if size in _kept else _kept.setdefault(size, _Group(size))
    try:
        return group.call(function, args)
    except BaseException:  # the others may wait for ever
        _kept.pop(size).end()
        raise


class _Group:
    def __init__(self, size: int) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        # One process imports torch and the code; the others are its forks.
        context = mp.get_context("forkserver")
        context.set_forkserver_preload(["train", "groundwork.ranks.process_group"])
        self._pipes, self._processes = [], []
        for rank in range(size):
            mine, theirs = context.Pipe()
            self._pipes.append(mine)
            self._processes.append(context.Process(target=_serve, args=(rank, size, port, theirs), daemon=True))
            self._processes[-1].start()
            theirs.close()

    def call(self, function: Callable[..., Any], args: tuple) -> list[Any]:
        for pipe in self._pipes:
            pipe.send_bytes(pickle.dumps((function, args)))
        results: dict[Connection, Any] = {}
        while len(results) < len(self._pipes):
            for pipe in wait([pipe for pipe in self._pipes if pipe not in results]):
                results[pipe], error = pickle.loads(pipe.recv_bytes())
                if error:
                    raise AssertionError(f"rank {self._pipes.index(pipe)}: {error}")
        return [results[pipe] for pipe in self._pipes]

    def end(self) -> None:
        for process in self._processes:
            process.kill()


def _serve(rank: int, size: int, port: int, pipe: Connection) -> None:
    torch.set_num_threads(1)
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "GLOO_SOCKET_IFNAME": "lo"}
    dist.init_process_group("gloo", rank=rank, world_size=size)
    streams = sys.stdout, sys.stderr
    while True:
        try:
            function, args = pickle.loads(pipe.recv_bytes())
        except EOFError:  # the tests are over
            return
        try:
            with using(SeveralRanks()):
                answer = function(*args), ""
        except BaseException:
            answer = None, traceback.format_exc()
        sys.stdout, sys.stderr = streams  # trainings stamp what they print
        pipe.send_bytes(pickle.dumps(answer))
