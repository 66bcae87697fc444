"""Benchmarks of training over several ranks, on scenes that are drawn and not read."""
