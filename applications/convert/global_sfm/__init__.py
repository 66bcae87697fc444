"""Global structure from motion: rotations, then positions, then one adjustment of all, without COLMAP's mappers.

matches.py reads the pairs of photos, relative_poses.py poses each pair, rotations.py and positions.py place all photos,
tracks.py and points.py make points, and mapper.py calls them in order, with COLMAP's bundle adjustment.
"""
