"""SOG, the format of PlayCanvas. Its own program splat-transform writes it, which needs Node."""

import contextlib
import os
import subprocess
import sys
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from urllib.parse import quote

from groundwork.host.programs import find_program
from groundwork.host.progress import Bar
from scene.splats.ply import write_plain_ply
from scene.splats.splats import Splats
from utils.system_utils import UserError, atomic_write, temporary_folder

PROGRAM = "splat-transform"
_MINUTES = 3.4 / 12_000**2  # by Gaussians with SH bands, times the clusters of these bands: as many, up to _CLUSTERS
_CLUSTERS = 65_536
_LOOK = 0.5  # seconds
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
    warn_if_slow(len(splats), splats.sh_degree)
    with temporary_folder() as folder, atomic_write(path) as temporary:
        model, packed = folder / "model.ply", folder / "model.sog"
        write_plain_ply(model, splats)
        run_program(program, [str(model)], packed, path)
        _copy_without_dates(packed, temporary)


def warn_if_slow(count: int, sh_degree: int) -> None:
    """Say before the wait why splat-transform takes minutes, and what takes none."""
    minutes = round(_MINUTES * count * min(count, _CLUSTERS))
    if sh_degree and minutes:
        print(
            f"{PROGRAM} takes about {minutes:,} min for the SH bands of {count:,} Gaussians, as it compares them "
            "with each other, on the CPU, so that files repeat; --sh_degree 0 or a .spz takes seconds",
            file=sys.stderr,
        )


def run_program(program: str, inputs: Sequence[str], output: Path, path: str | os.PathLike) -> None:
    """Have splat-transform write `output`, the same bytes each time. UserError, about `path`, if it cannot.

    Its progress is shown.
    """
    # Without a GPU, as its results differ from machine to machine.
    options = [os.environ.get("NODE_OPTIONS", ""), f"--import=data:text/javascript,{quote(_SEEDED)}"]
    environment = {**os.environ, "NODE_OPTIONS": " ".join(options).strip()}
    command = [program, "--overwrite", "--gpu", "cpu", *inputs, os.path.abspath(output)]
    if fault := find_fault(command, output, environment):
        raise UserError(f"{PROGRAM} could not write {path} ({fault}); choose another format, or update it")


def find_fault(command: Sequence[str], output: Path, environment: Mapping[str, str] | None = None) -> str:
    """Run splat-transform, show the last line that it has said, and return why it wrote no `output`; "" if it did."""
    bar = Bar(desc=PROGRAM, bar_format="{desc}: {elapsed}{postfix}", leave=False)
    with temporary_folder() as folder, open(folder / "log", "wb") as log, bar:
        with subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=environment) as process:
            try:
                while process.poll() is None:
                    bar.set_postfix_str(_read_lines(folder / "log")[-1])
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        process.wait(_LOOK)
            except BaseException:
                process.kill()
                raise
        said = _read_lines(folder / "log")
    if not process.returncode and output.is_file():
        return ""
    return next((line for line in said if "error" in line.lower()), said[-1])


def _read_lines(log: Path) -> list[str]:
    """Return the lines that the program printed, without bullets and paths of its code."""
    text = log.read_text(encoding="utf-8", errors="replace").replace("\r", "\n")
    return [line.strip(" ▸·✗") for line in text.splitlines() if line.strip()] or ["it said nothing"]


def _copy_without_dates(source: Path, target: Path) -> None:
    """Copy a ZIP file. Its members keep their order and bytes, and get the date that a ZipInfo has by default."""
    with zipfile.ZipFile(source) as read, zipfile.ZipFile(target, "w") as written:
        for member in read.infolist():
            written.writestr(zipfile.ZipInfo(member.filename), read.read(member))
