"""Conversion of photos or a video to a COLMAP scene; the parts of convert.py."""
