"""The web page that shows a model, during its training or from its folder.

views, frames       a frame: what the controls ask for, from which camera, and the image for it
watchers            when to draw: cameras of the browsers, share of time
server, auth        where the page listens, who may connect, and what a browser may send
page, tabs          the page and its controls
"""
