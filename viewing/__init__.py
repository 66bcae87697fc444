"""The web page that shows a model, during its training or from its folder.

settings, frames, tints     a frame: what the controls ask for, and the picture for it
model_part                  the part of a model that a frame shows
budget, watchers            when to draw: share of time, cameras of the browsers
texts, in_turn              texts that can be sent, callbacks that do not overlap
gate, connections           who may connect, and what a browser may send
server, options             where the page listens
page, view_tab, path_tab, training_tab, scene_cameras     the controls
saved                       the page of a saved model
"""
