"""SOG, the format of PlayCanvas. Its own program splat-transform writes it, which needs Node."""

import os
import subprocess
import zipfile
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from scene.splats.ply import write_plain_ply
from scene.splats.splats import Splats
from splatting.host.programs import find_program
from utils.system_utils import UserError, atomic_write, temporary_folder

PROGRAM = "splat-transform"
# The program clusters the SH bands from a random start and has no option for a seed, so it gets a Math.random with one
# (xorshift, Marsaglia 2003). Without it 600 Gaussians with random SH bands came out at 34 to 39 dB by chance.
_SEEDED = "let s=1;Math.random=()=>{s^=s<<13;s^=s>>>17;s^=s<<5;return(s>>>0)/2**32}"


def find_splat_transform(path: str | os.PathLike) -> str:
    """The program that a file of this name needs. UserError without it."""
    program = find_program(PROGRAM)
    if program is None:
        raise UserError(f"{path} needs {PROGRAM}; install Node, then run npm install -g @playcanvas/splat-transform")
    return program


def write_sog(path: str | os.PathLike, splats: Splats) -> None:
    """Write a SOG file, whole or not at all. UserError without splat-transform."""
    program = find_splat_transform(path)
    if not len(splats):
        raise UserError(f"{path} would have no splats, which {PROGRAM} does not write; choose another format")
    with temporary_folder() as folder, atomic_write(path) as temporary:
        model, packed = folder / "model.ply", folder / "model.sog"
        write_plain_ply(model, splats)
        run_program(program, [str(model)], packed, path)
        _copy_without_dates(packed, temporary)


def run_program(program: str, inputs: Sequence[str], output: Path, path: str | os.PathLike) -> None:
    """Have splat-transform write `output`, the same bytes each time. UserError, about `path`, if it cannot."""
    # Without a GPU, as its results differ from machine to machine.
    options = [os.environ.get("NODE_OPTIONS", ""), f"--import=data:text/javascript,{quote(_SEEDED)}"]
    environment = {**os.environ, "NODE_OPTIONS": " ".join(options).strip()}
    command = [program, "--quiet", "--overwrite", "--gpu", "cpu", *inputs, os.path.abspath(output)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if done.returncode or not output.is_file():
        said = (done.stderr or done.stdout).strip().splitlines() or ["it said nothing"]
        raise UserError(f"{PROGRAM} could not write {path} ({said[-1]}); choose another format, or update it")


def _copy_without_dates(source: Path, target: Path) -> None:
    """Copy a ZIP file. Its members keep their order and bytes, and get the date that a ZipInfo has by default."""
    with zipfile.ZipFile(source) as read, zipfile.ZipFile(target, "w") as written:
        for member in read.infolist():
            written.writestr(zipfile.ZipInfo(member.filename), read.read(member))
