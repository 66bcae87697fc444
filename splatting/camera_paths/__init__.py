"""Paths of a camera through a scene, for videos and viewers.

keyframes, moments, poses       a path's file, its pose at each moment, cameras as arrays
interpolated, generated         paths made from the training cameras
request, render_path, video     a video of a path
"""
