"""The version of this code: version.txt, the one place where it is written by hand."""

from pathlib import Path

_FILE = Path(__file__).resolve().parents[2] / "version.txt"
VERSION = _FILE.read_text(encoding="utf-8").strip() if _FILE.is_file() else "unknown"  # where only the code was copied
