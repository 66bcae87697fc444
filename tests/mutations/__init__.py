"""Real faults of other programs, one at a time in a private copy of this project: which test finds each, at what cost.

python -m tests.mutations [NAME ...] [--psnr SCENE]

__main__     the command line, and the table
faults       the faults, as substitutions in our sources
private_copy the copy of the project and its builds
"""
