"""From photos or a video to a COLMAP scene: what convert.py is made of."""
