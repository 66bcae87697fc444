"""Strategies: how many Gaussians there are, and where. Each is a file, chosen by --strategy."""
