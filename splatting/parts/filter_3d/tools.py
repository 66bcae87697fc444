"""A checkpoint's model as it is drawn."""

from typing import Any

from scene.gaussians.attributes import Rows
from scene.gaussians.filtered import filtered
from splatting.parts.filter_3d.smoothing import check_widths


def drawn(rows: Rows, states: dict[str, Any]) -> Rows:
    """Rows of a checkpoint as its PLY would have them. states: of parts, by name."""
    if (widths := states.get("filter_3d")) is None:
        return rows
    check_widths(widths, len(rows["xyz"]))
    opacity, scaling = filtered(rows["opacity"], rows["scaling"], widths.to(rows["xyz"].device))
    return rows | {"opacity": opacity, "scaling": scaling}
