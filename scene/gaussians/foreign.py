"""Columns of other programs' PLYs that we read or report, and values in other units than ours."""

import math
import os
from collections.abc import Collection

import numpy as np
import torch
from torch import Tensor

from groundwork.deterministic.portable_math import exp, log
from groundwork.files.ply_header import header_lines
from groundwork.files.unread import note_once, note_unread
from scene.gaussians.attributes import Rows

_FILTER = "filter_3D"  # the width of a Gaussian's filter, which Mip-Splatting and what follows it leave to the renderer
_MOVING = ("trbf_", "motion_", "omega_")  # beginnings of columns: Gaussians that come, go and move
_LARGE = 0.01  # of the model's extent: a usual size that no trained model has
_NO_LOGIT = 50.0  # beyond it, values are percent or bytes


def apply_foreign_filter(path: str | os.PathLike, rows: Rows, vertices: np.ndarray, used: Collection[str]) -> Rows:
    """Apply a PLY's own 3D filter to its rows; print a line on that, and on columns that are not used.

    A warning is printed for values that are no logits or logarithms. used: names of the columns of the rows.
    """
    _warn_of_units(path, rows)
    names = set(vertices.dtype.names or ()) - set(used)
    if _FILTER in names and not vertices.dtype[_FILTER].hasobject and rows["scaling"].shape[1] == 3:
        names.remove(_FILTER)
        note_once(
            f"{path} has the 3D filter of Mip-Splatting ({_FILTER}), which is applied; its renders are right with "
            "--antialiasing"
        )
        widths = torch.from_numpy(np.asarray(vertices[_FILTER], np.float32).reshape(-1, 1).copy())
        opacity, scaling = _apply_filter(rows["opacity"], rows["scaling"], widths)
        rows = rows | {"opacity": opacity, "scaling": scaling}
    note_unread(path, "ply", names)
    elements = {words[1] for line in header_lines(path) if len(words := line.split()) == 3 and words[0] == "element"}
    note_unread(path, "ply elements", elements - {"vertex"})
    if any(name.startswith(_MOVING) for name in names) or any(name.startswith("delta_") for name in elements):
        note_once(f"warning: {path} is a model that moves, of which only one state is drawn; some of it may look wrong")
    return rows


def _apply_filter(logits: Tensor, log_scales: Tensor, widths: Tensor) -> tuple[Tensor, Tensor]:
    """Apply the filter of `widths` (N, 1) of Mip-Splatting (Yu et al. 2024) to logits (N, 1) and log scales (N, 3).

    Variances grow by that of the filter, and the opacity falls with the square root of the covariance's determinant.
    """
    x, s, width = logits.double(), log_scales.double(), widths.double()
    wider = 0.5 * log(1 + width * width * exp(-2 * s))
    fainter = wider[:, :1] + wider[:, 1:2] + wider[:, 2:]  # -ln of sqrt(determinant before / after)
    # The new 1 / opacity - 1 is `rest` over exp(-fainter), and for x < 0 over e, too: no term overflows.
    e, positive = exp(-x.abs()), x > 0
    rest = torch.where(positive, e, 1.0) + torch.where(positive, 1.0, e) * (1 - exp(-fainter))
    return (x.clamp_max(0) - fainter - log(rest)).to(logits.dtype), (s + wider).to(log_scales.dtype)


def _warn_of_units(path: str | os.PathLike, rows: Rows) -> None:
    """Warn if opacities, colours and scales seem to be plain values, no logits, SH coefficients and logarithms.

    A trained model has faint and dark Gaussians, with values below 0, and sizes far below its extent.
    """
    if not len(rows["xyz"]):
        return
    remedy = "export the model again in the form of 3DGS"
    for what, part, form in (("opacities", "opacity", "logits"), ("colours", "f_dc", "SH coefficients")):
        low, high = float(rows[part].min()), float(rows[part].max())
        if low >= 0 and (0 < high <= 1 or _NO_LOGIT < high < math.inf):
            found = f"{what} of {path} are from {low:.3g} to {high:.3g}"
            note_once(f"warning: all {found}, so they may be no {form}; {remedy}")
    scales = rows["scaling"]
    if scales.min() >= 0 and scales.max() > 0 and float(scales.median().exp()) > _LARGE * _measure_extent(rows["xyz"]):
        note_once(f"warning: all scales of {path} are above 0, so they may be no logarithms; {remedy}")


def _measure_extent(points: Tensor) -> float:
    """The usual distance of points (N, 3) from their middle."""
    return float((points - points.median(dim=0).values).norm(dim=1).median())
