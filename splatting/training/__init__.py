"""The training loop and its parts; `train.py` is its command line.

loop                   an iteration from top to bottom, and what happens beside it
run, iteration         what the loop gets: a run made from the options, and what each iteration needs
objective              the loss
schedule               the steps of the schedule that an iteration stands for
steps/                 faster forms of a step, to the same bytes: fused, captured
log, scores, save, watch
                       what watches every training: records, scores, saves and checkpoints, refusals
folder                 the folder of a training, and what earlier runs in it allow
agreement              several processes: what they share before and in each iteration
"""
