"""What train.py is made of besides its loop.

checks, history            before: may this be trained, and what have earlier runs left
memory_estimate            what it will want
view_order                 which camera in which iteration
report, curve              scores on the way
divergence, memory_guard   a training that goes wrong ends in a sentence, with its model saved
mask_watch                 masks that leave nothing to train on
last_save                  the finished model without what it does not need
"""
