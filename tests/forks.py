"""Runs programs in forks of a process that has imported torch, which takes longer than most of what is run in them."""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
# Reads lines of JSON: code and words; writes the status that a fork of it has ended with, where these ran.
_FORKS = """
import io, json, os, sys, traceback
import numpy, plyfile, scipy.spatial, torch
for line in sys.stdin:
    code, words, out, err = json.loads(line)
    child = os.fork()
    if not child:
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(os.open(out, os.O_WRONLY), 1)
        os.dup2(os.open(err, os.O_WRONLY), 2)
        sys.argv, status = ["-c", *words], 1
        try:
            exec(compile(code, "<program>", "exec"), {"__name__": "__main__"})
            status = 0
        except SystemExit as ended:
            status = ended.code if isinstance(ended.code, int) else bool(ended.code)
        except BaseException:
            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""
_kept: list[subprocess.Popen] = []


class Done(NamedTuple):
    """The end of a program, and its output."""

    status: int
    stdout: str
    stderr: str


def fork(code: str, *words: str) -> Done:
    """Run code by a process of its own, in the folder of the project, with `words` as sys.argv[1:].

    torch, numpy, SciPy and plyfile are imported then, and nothing of ours is.
    """
    if not _kept:
        command = [sys.executable, "-c", _FORKS]
        streams = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
        _kept.append(subprocess.Popen(command, cwd=ROOT, env=environment, text=True, bufsize=1, **streams))
    with tempfile.NamedTemporaryFile() as out, tempfile.NamedTemporaryFile() as err:
        print(json.dumps([code, words, out.name, err.name]), file=_kept[0].stdin)
        status = int(_kept[0].stdout.readline())
        return Done(status, Path(out.name).read_text(), Path(err.name).read_text())
