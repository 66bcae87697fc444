"""export.py's files: its table of formats, and those that only it writes; scene/splats/ has those that are read."""
