"""Random damage to everything that a user can give: files and options.

python -m tests.fuzz SECONDS SEED

__main__                             the command line
damage                               changes of bytes and of nested values
files, models, pickles, pictures, options   the kinds of cases
crafted_pickles                      hostile files of torch.save, one by one
worker                               a process that runs cases and measures them
sandbox                              starts workers, and notices when one crashes or hangs
operators                            changed calls of every operator, for tests/test_operator_arguments.py
"""

# Classes of cases, by kind. The worker imports them; the process that starts it stays free of torch.
KINDS = {
    "colmap": "files:Colmap",
    "transforms": "files:Transforms",
    "cloud": "files:Cloud",
    "ply": "models:Ply",
    "splats": "models:Splats",
    "checkpoint": "models:Checkpoint",
    "pickle": "pickles:Mutated",
    "crafted": "pickles:Crafted",
    "picture": "pictures:Picture",
    "options": "options:Options",
}
