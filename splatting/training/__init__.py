"""The training loop and its parts; `train.py` is its command line.

loop                       the method, on one page
run, stepping, iteration   what the loop gets: a run made from the options, what each iteration needs, one iteration
steps/                     the step of an iteration: plain, fused or captured
objective                  the loss
density                    the hooks of density control; the strategies are parts (splatting/part.py)
schedule                   the steps of the schedule that an iteration stands for
announcer, observers/      what watches every training: checks, progress, scores, records, saves, checkpoints
checks, earlier_runs       before: what is refused, by the scene and by what earlier runs have left
strategy_warnings, memory_estimate
                           before: what is warned of, and how much memory a training needs
launch                     options of train.py besides the three groups
output_folder, restart     the folder that a training writes into, and where one that starts anew goes on
consistency, step_agreement
                           several processes: what they share in each iteration
"""
