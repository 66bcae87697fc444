"""The training loop and what it is made of; `train.py` is its command line.

loop                       the method, on one page
run, plan, step            what the loop works on: a run made from the options, what it was asked for, one iteration
objective                  the loss
density                    density control; another strategy is another class with the same hooks
observer, observers/       everything that watches: checks, progress, curve, report, saves, checkpoints
checks, history            before: whether the scene can be trained, and traces of earlier runs
memory_estimate            before: how much memory a training will want
view_order                 the camera of each iteration
left_out                   after: the lines about what the saved model does not need
"""
