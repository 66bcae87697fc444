"""Benchmarks of the file formats that export.py writes."""
