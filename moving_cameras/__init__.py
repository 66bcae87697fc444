"""Paths of a camera through a scene, for videos and viewers."""
