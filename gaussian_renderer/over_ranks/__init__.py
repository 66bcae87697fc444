"""Rendering of one view by several processes, each of which has a shard of the Gaussians and a band of the image."""
