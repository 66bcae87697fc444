"""The training loop and its parts; `train.py` is its command line.

loop                       the method, on one page
run, iteration             the loop's inputs: a run made from the options, one iteration and its view
steps/                     the step of an iteration: plain, fused or captured
objective                  the loss
part, option               what a feature adds to a training, in one class; the features lie in splatting/parts
density                    the hooks of density control; the strategies lie in splatting/parts
schedule                   the steps of the schedule that an iteration stands for
announcer, observers/      what watches every training: checks, progress, scores, records, saves, checkpoints
checks, memory_estimate    before: what is refused or warned of, and an estimate of the memory that a training needs
launch                     options of train.py besides the three groups
agreement, output_folder   several processes: what has to be the same on all before the start, and one output folder
together, restart          several processes: what they share in each iteration, and where a restarted training goes on
"""
