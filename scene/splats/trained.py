"""Checkpoints of gsplat's trainer (.pt) and nerfstudio (.ckpt): their tensors are read, and nothing of them is run."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from groundwork.files.tensor_files import read_tensors
from groundwork.files.unread import note_once
from scene.splats.splats import Splats
from utils.sh_utils import RGB2SH
from utils.system_utils import UserError

_OTHERS = {"features_dc": "sh0", "features_rest": "shN"}  # nerfstudio's names, and gsplat's
_SHAPES = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3)}
_MOST_BANDS = 15  # of shN


def read_trained(path: str | os.PathLike) -> Splats:
    """The Gaussians of a checkpoint, with SH bands up to degree 3. UserError for any other file."""
    remedy = "export a PLY with the program that wrote it"
    try:
        content = read_tensors(path)
    except ValueError as error:
        raise UserError(f"{path} is not a checkpoint that can be read ({error}); {remedy}") from error
    content = content if isinstance(content, dict) else {}
    program, part = ("gsplat", "splats") if "splats" in content else ("nerfstudio", "pipeline")
    try:
        values = _read_values(content[part])
    except (LookupError, TypeError, ValueError, RuntimeError, AttributeError) as error:
        raise UserError(f"{path} is a checkpoint without Gaussians of gsplat or nerfstudio; {remedy}") from error
    note_once(f"{path} is of {program}: it fits the cameras of a scene if its training did not normalize the world")
    if len(rank := sorted(Path(path).parent.glob(f"{Path(path).stem.rpartition('_rank')[0]}_rank*.pt"))) > 1:
        note_once(f"warning: {path} has a part of the Gaussians; all are in {rank[0].name} to {rank[-1].name}")
    if values["shN"].shape[1] > _MOST_BANDS:
        note_once(f"warning: SH bands of degree 4 of {path} are left out; models have at most degree 3")
    if program == "nerfstudio" and not values["shN"].shape[1]:  # it has colours instead then
        values["sh0"] = RGB2SH(values["sh0"].sigmoid())
    sh = torch.cat([values["sh0"], values["shN"][:, :_MOST_BANDS]], dim=1)
    parts = (values["means"], values["scales"], values["quats"], values["opacities"], sh)
    return Splats(*(x.contiguous().numpy() for x in parts))


def _read_values(found: Mapping[Any, Any]) -> dict[str, Tensor]:
    """The raw values by gsplat's names, float32. KeyError and others for what is no Gaussians."""
    short = {str(name).removeprefix("_model.").removeprefix("gauss_params."): x for name, x in found.items()}
    short = {_OTHERS.get(name, name): x for name, x in short.items()}
    count = len(short["means"])
    bands = short["shN"].shape[1]
    if bands not in (0, 3, 8, 15, 24):
        raise ValueError("no SH degree")
    shapes = _SHAPES | {"shN": (bands, 3)}
    return {name: short[name].detach().float().reshape(count, *shape) for name, shape in shapes.items()}
