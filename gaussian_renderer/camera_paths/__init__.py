"""Paths of a camera through a scene, for videos and viewers.

keyframes, poses        a path's file and its pose at each moment, cameras as arrays
generated               paths made from the training cameras
start                   the camera that pages begin at
render_path, video      a video of a path
from_above              a picture from above
"""
