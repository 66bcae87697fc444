"""Gaussians of files: the record of their values, and the formats that are read, each beside its writing."""
