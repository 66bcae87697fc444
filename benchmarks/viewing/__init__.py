"""Benchmarks of the web page: frames, delays, and what they take from a training."""
