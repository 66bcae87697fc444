"""A check for views that --projection ray cannot draw, before anything is written."""

import argparse
from collections.abc import Callable, Iterable

import groundwork.host.extensions  # noqa: F401  isort: skip  (before the extensions)
from diff_gaussian_rasterization.scene import check_rays

from scene.cameras import Camera
from utils.system_utils import UserError


def check_views(
    pipe: argparse.Namespace, views: Iterable[Camera], size_of: Callable[[Camera], tuple[int, int]] | None = None
) -> None:
    """Refuse a view whose lens has rays that the kernels cannot find (UserError).

    size_of: the size (width, height) in which a view is drawn; None: the view's own.
    """
    if getattr(pipe, "projection", "ewa") != "ray":
        return
    for view in views:
        if getattr(view, "lens", None) is None:
            continue
        width, height = size_of(view) if size_of else (view.image_width, view.image_height)
        try:
            check_rays(view.lens.scaled(width / view.image_width, height / view.image_height))
        except ValueError as error:
            raise UserError(
                f"{view.image_name} cannot be rendered at {width} x {height} pixels, as {error}; use a larger "
                "--resolution (-r) and no smaller views at the start, or --projection ewa"
            ) from error
