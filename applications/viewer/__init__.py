"""The web page that shows a model, during its training or from its folder.

views, frames, legend        a frame: what the controls ask for, from which camera, its image, and what its colours mean
coverage                     what training views have shown
watchers                     when to draw: cameras of the browsers, share of time
server                       where the page listens, and who may ask for it
page                         the page, and what it writes
tabs, *_tab                  its controls
frusta, divider              the scene's cameras, and the line between photo and render, as a browser draws them
"""
