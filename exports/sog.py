"""SOG, the format of PlayCanvas for the web, written by its own program splat-transform, which needs Node."""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from exports.plain_ply import write_plain_ply
from exports.splats import Splats
from utils.system_utils import UserError, atomic_write

PROGRAM = "splat-transform"


def find_program(path: str | os.PathLike) -> str:
    """The program that a file of this name needs. UserError without it."""
    program = shutil.which(PROGRAM) or shutil.which(PROGRAM, path="node_modules/.bin")
    if program is None:
        raise UserError(f"{path} needs {PROGRAM}; install Node, then run npm install -g @playcanvas/splat-transform")
    return program


def write_sog(path: str | os.PathLike, splats: Splats) -> None:
    """Write the file, whole or not at all. UserError without splat-transform, on PATH or in ./node_modules."""
    program = find_program(path)
    if not len(splats):
        raise UserError(f"{path} would have no splats, which {PROGRAM} does not write; choose another format")
    with tempfile.TemporaryDirectory() as folder, atomic_write(path) as temporary:
        model = Path(folder) / "model.ply"
        write_plain_ply(model, splats)
        # Without a GPU, as its results differ from machine to machine.
        command = [program, "--quiet", "--overwrite", "--gpu", "cpu", str(model), str(temporary)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode or not temporary.is_file():
            said = (done.stderr or done.stdout).strip().splitlines() or ["it said nothing"]
            raise UserError(f"{PROGRAM} could not write {path} ({said[-1]}); choose another format, or update it")
