"""Kill trainings at random and at aimed moments, resume them, and compare the end with a training that was let be.

python -m tests.kills N [SEED]

Kills are SIGKILL: after a random time, and before, in or after the n-th write of a file. A trial kills one to three
times, each time resuming from the newest checkpoint. At its end the PLYs, the tensors of the checkpoints and the names
of all files must be those of the training that was let be, with no temporary file or lock left over.
"""
