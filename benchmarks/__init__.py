"""Measurements, one command per table; README.md lists them. Run each as `python -m benchmarks.ROOM.NAME`."""

import groundwork.host.openmp  # noqa: F401  (has to precede every import of torch)
