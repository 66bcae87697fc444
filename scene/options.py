"""Model options that code written for the reference may lack, with their defaults.

Nothing is imported from `arguments`: such code may have a package of that name, which would be found first.
"""

from typing import Any

DEFAULTS = {
    "depths": "",  # this and the next: unknown to the reference's release of 2023
    "train_test_exp": False,
    "init_pcd_path": "",
    "init_ply": "",
    "init_type": "sfm",
    "masks": "",
    "invert_masks": False,
    "mask_meaning": "auto",
    "images_to_load": 0,
}


def option(args: object, name: str) -> Any:
    """The value of an option of DEFAULTS in `args`; its default if `args` lacks it or has None."""
    value = getattr(args, name, None)
    return DEFAULTS[name] if value is None else value
