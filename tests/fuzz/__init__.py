"""Random damage to everything that a user can give: files, options, and arguments of the rasterizer.

python -m tests.fuzz SECONDS SEED

command                              the command line
damage                               changes of bytes and of nested values
files, models, pickles, pictures, options, rasterizer
                                     the kinds of cases
crafted_pickles                      hostile files of torch.save, one by one
worker                               a process that runs cases and measures them
sandbox                              starts workers, and notices when one crashes or hangs
operators                            changed calls of every operator, for tests/test_operator_arguments.py
"""
