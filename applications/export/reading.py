"""Reading a model in any format: also those that other programs read for us."""

import os
from pathlib import Path

from applications.export.sog import find_fault, find_splat_transform
from scene.splats.reading import READABLE
from scene.splats.splats import Splats
from scene.with_splats import splats_in
from utils.system_utils import UserError, temporary_folder

ANY = f"{READABLE}, or .sog through splat-transform"


def read_any(path: str | os.PathLike) -> Splats:
    """The Gaussians of a file, as `splats_in`; of a SOG as PlayCanvas' program reads it. UserError without that."""
    if Path(path).suffix.lower() != ".sog" or not os.path.isfile(path):
        return splats_in(path)
    program = find_splat_transform(path)
    with temporary_folder() as folder:
        model = folder / "model.ply"
        if fault := find_fault([program, os.path.abspath(path), str(model)], model):
            raise UserError(f"{path} is not read by {program} ({fault}); save or download it again")
        return splats_in(model)
