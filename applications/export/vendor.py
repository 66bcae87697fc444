"""Maker of exports/viewer/: the viewer that HTML exports carry, from its npm package.

python -m applications.export.vendor

Needs Node, npm and the network, and is run only when the viewer's version changes: vendored.json, in that folder, names
package, version and minifier, and the SHA-256 of each file, unpacked. The same record gives the same code on any
machine; other code is an error, and nothing is written.
"""

import gzip
import hashlib
import json
import subprocess
from argparse import ArgumentParser
from collections.abc import Sequence
from pathlib import Path

from groundwork.host.programs import find_program
from utils.system_utils import UserError, atomic_write, run_cli, temporary_folder

ROOT = Path(__file__).resolve().parents[2]
FOLDER = Path(__file__).resolve().parent / "viewer"
RECORD = FOLDER / "vendored.json"
VIEWER = "viewer.js.gz"  # packed as each page carries it, a quarter of its size
UNPACKED = VIEWER.removesuffix(".gz")
_SOURCES = {UNPACKED: "public/index.js", "viewer.css": "public/index.css"}  # our name: the package's, to be minified


def main(argv: Sequence[str] | None = None) -> None:
    """Make the files anew."""
    description = f"Make {FOLDER.relative_to(ROOT)}/ from the npm package and minifier that its vendored.json names."
    ArgumentParser(prog="python -m applications.export.vendor", description=description).parse_args(argv)
    record = json.loads(RECORD.read_text(encoding="utf-8"))
    if not find_program("npm"):
        raise UserError("npm is not installed; install Node 20 or later, which brings it")
    with temporary_folder() as folder:
        package, minifier = _install(record, folder)
        files = {"LICENSE": (package / "LICENSE").read_bytes()}
        for name, source in _SOURCES.items():
            # The words that put name and licence into the file's first line.
            banner = f"/*! {record['package']} {record['version']}, {record['license']}: see LICENSE */"
            options = ["--minify", "--charset=utf8", f"--banner:{name.rpartition('.')[2]}={banner}"]
            files[name] = _run_command([minifier, package / source, *options])
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in sorted(files.items())}
    if digests != record["sha256"]:
        raise UserError(f"the files differ from those of {RECORD}; after a look at them, enter {json.dumps(digests)}")
    files[VIEWER] = gzip.compress(files.pop(UNPACKED), mtime=0)
    for name, content in files.items():
        with atomic_write(FOLDER / name) as written:
            written.write_bytes(content)
        print(f"{FOLDER / name}: {len(content):,} bytes")


def _install(record: dict, folder: Path) -> tuple[Path, Path]:
    """The package's folder, and the minifier."""
    named = f"{record['package']}@{record['version']}", f"esbuild@{record['esbuild']}"
    _run_command(
        [find_program("npm"), "install", "--silent", "--ignore-scripts", "--no-save", "--prefix", folder, *named]
    )
    modules = folder / "node_modules"
    return modules / record["package"], modules / ".bin" / "esbuild"


def _run_command(command: list[str | Path]) -> bytes:
    done = subprocess.run(command, capture_output=True)
    if done.returncode:
        raise UserError(f"{' '.join(map(str, command))} failed: {done.stderr.decode(errors='replace').strip()}")
    return done.stdout


if __name__ == "__main__":
    run_cli(main)
