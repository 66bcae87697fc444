"""What export.py knows of a region: that it may leave out all else."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from torch import Tensor

from splatting.files.json_files import read_model_json
from splatting.parts.region.shape import restored
from utils.system_utils import UserError


def add_export_options(add: Callable[..., Any]) -> None:
    """Add options to those of export.py."""
    add("--only_region", action="store_true", help="leave out what lies outside of train.py --region (default: keep)")


def left_out(args: argparse.Namespace, means: Tensor) -> Tensor | None:
    """Which Gaussians those options leave out, (N,) bool. UserError where that cannot be told."""
    if not args.only_region:
        return None
    numbers = read_model_json(Path(args.model_path)).get("region") if args.model_path else None
    if not numbers:
        raise UserError("--only_region needs a model folder (-m) that was trained with --region; leave it out")
    return ~restored(numbers).holds(means)
