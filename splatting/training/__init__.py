"""The training loop and its parts; `train.py` is its command line.

loop                       the method, on one page
run, step                  the loop's inputs: a run made from the options, one iteration
objective                  the loss
density                    density control; another strategy is another class with the same hooks
observer, observers/       everything that watches: checks, progress, curve, report, saves, checkpoints
checks, history            before: checks that the scene can be trained, and traces of earlier runs
memory_estimate            before: an estimate of the memory that a training needs
view_order                 the camera of each iteration
launch                     options of train.py besides the three groups
agreement                  several ranks: what has to be the same on all before the start
together, restart          several ranks: what they share in each iteration, and where a restarted training goes on
left_out                   after: the lines about what the saved model does not need
"""
