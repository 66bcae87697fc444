"""Limits on threads that spin while they wait for work. Import this module before torch and NumPy if possible.

Threads of torch's OpenMP spin for milliseconds by default, and so block cores that other programs want. On two busy
cores, 300 iterations of a small scene took 42 s, and 9 s with short spinning. On idle cores both take 6 s.

Threads of NumPy's OpenBLAS spin for a tenth of a second on every core after one dot product of 10,000 numbers, as in a
histogram for TensorBoard. NumPy computes nothing here that is worth a second thread.
"""

import os
import sys
import threading

_MOST_TEAMS = 4  # where torch uses so few of the cores that more would be needed, spinning takes no core that is short


def _add_idle_teams() -> None:
    """Shorten the spinning of an OpenMP that has read its settings already, as in a program that imports torch first.

    GNU's OpenMP spins only 100 times once there are more threads than cores (its manual, GOMP_SPINCOUNT). Sleeping
    threads count, so this starts teams that do one small task and then wait for ever.
    """
    import torch

    cores, threads = len(os.sched_getaffinity(0)), torch.get_num_threads()
    teams = 0 if threads == 1 else (cores - threads) // (threads - 1) + 1

    def work_once() -> None:
        torch.zeros(1 << 18).add_(1)  # large enough for all threads of a team
        threading.Event().wait()

    for _ in range(teams if teams <= _MOST_TEAMS else 0):
        threading.Thread(target=work_once, name="idle OpenMP team", daemon=True).start()


if not {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"} & set(os.environ):
    os.environ["GOMP_SPINCOUNT"] = "1000"
    if "torch" in sys.modules and sys.platform == "linux":
        _add_idle_teams()
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
