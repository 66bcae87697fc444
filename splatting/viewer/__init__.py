"""The web page that shows a model, during its training or from its folder.

settings, frames, colormaps     a frame: what the controls ask for, and the image for it
watchers                        when to draw: cameras of the browsers, share of time
auth, connections               who may connect, and what a browser may send
server, options                 where the page listens
page, tabs, training_tab, scene_cameras     the page and its controls
"""
