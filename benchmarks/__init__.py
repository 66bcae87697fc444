"""Measurements, one command a table: README.md lists them. Run each as `python -m benchmarks.ROOM.NAME`."""

import utils.host.openmp  # noqa: F401  (before any command here imports torch)
