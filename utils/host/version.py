"""The version of this code: version.txt, the one place where it is written by hand."""

from pathlib import Path

VERSION = (Path(__file__).resolve().parents[2] / "version.txt").read_text(encoding="utf-8").strip()
