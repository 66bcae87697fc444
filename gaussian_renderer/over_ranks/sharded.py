"""Views of a model that may be divided among ranks, so that the renderer need not distinguish."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from diff_gaussian_rasterization import rasterize
from diff_gaussian_rasterization.ops import Rasterized, gradients_of
from diff_gaussian_rasterization.scene import GRADIENTS, Scene
from torch import Tensor

from gaussian_renderer.over_ranks.band import (
    View,
    camera_gradient,
    decisive_in,
    draw_view,
    exchange_halo,
    gather_image,
    gradient_rows,
)
from gaussian_renderer.over_ranks.bands import CachedBands as CachedBands
from gaussian_renderer.over_ranks.rasterize import rasterize_over
from groundwork.ranks.ranks import ALONE, Ranks
from scene.cameras import Camera, MiniCam
from scene.fused_adam import FusedAdam

_ONLY_COLORS = [name == "colors" for name in GRADIENTS]


def gradient_of_colors(scene: Scene, source: Sequence[Tensor], planes: Sequence[Tensor | None]) -> Tensor:
    """Gradient (N, 3) of the Gaussians' colours, whether these were given or came from SH bands (`gradients_of`)."""
    given = scene._replace(colors=scene.means, sh_dc=None, sh_rest=None)  # any colours, as the image is linear in them
    return gradients_of(given, source, planes, _ONLY_COLORS)[_ONLY_COLORS.index(True)]


def _find_ranks(model: Any) -> Ranks:
    """The ranks among which a model's Gaussians are divided; `ALONE` for a whole model, of any class."""
    return getattr(getattr(model, "shards", None), "ranks", ALONE)


def rasterizer_of(model: Any) -> Callable[..., Rasterized]:
    """Return `rasterize`, or `rasterize_over` bound to the ranks among which a model is divided."""
    return partial(rasterize_over, ranks) if (ranks := _find_ranks(model)).several else rasterize


def draw_divided(
    model: Any,
    scene: Scene,
    background: Tensor,
    want_depth: bool,
    by_bands: bool,
    bands: CachedBands | None,
    camera: Camera | MiniCam,
    awake: Tensor | None = None,
) -> "DividedDrawn | None":
    """Draw a view as `draw` of the renderer does, for a model that is divided among ranks; None for a whole model.

    by_bands: true if each rank needs only its own band of the image, and the rows around it that a loss reads; false:
        every rank gets the whole image.
    bands: the divisions of views into bands that earlier visits found; None: they are found anew.
    awake: (blocks,) uint8, 0 for blocks of the rank's rows that sleep (scene/sleeping.py); None: all are awake.
    """
    if not (ranks := _find_ranks(model)).several:
        return None
    find = bands and partial(bands.find, camera.uid)
    view = draw_view(ranks, scene, background, want_depth, train=True, find=find, awake=awake)
    if bands:
        bands.note_processed(camera.uid, view.last)
    view = exchange_halo(view) if by_bands else gather_image(view)
    return DividedDrawn(view, scene, want_depth, by_bands, awake, model.shards.blocks)


class DividedDrawn:
    """A view of a divided model with its gradients, in place of `Drawn` of a whole model.

    band: rows of the image that are valid, and whose gradient is read: the band of this rank; None: all rows.
    """

    def __init__(
        self, view: View, scene: Scene, want_depth: bool, by_bands: bool, awake: Tensor | None, blocks: Sequence[int]
    ) -> None:
        """Keep a drawn view of a divided model, and what its gradients need.

        by_bands: true if this process has the loss of its own band of the image only.
        awake: (blocks,) uint8, 0 for blocks of the rank's rows that sleep and take no step; None: all are awake.
        blocks: number of blocks of rows that each rank has.
        """
        self.image, self.depth, self.radii = view.color, view.inverse_depth if want_depth else None, view.radii
        self.band = view.band if by_bands else None
        self._view, self._scene, self._awake, self._blocks = view, scene, awake, blocks

    def decisive(self) -> Tensor:
        return decisive_in(self._view)

    def color_gradient(self, image_gradient: Tensor) -> Tensor:
        return gradient_of_colors(self._scene, self._make_source((image_gradient, None, None), absolute=False), ())

    def camera_gradient(self, image_gradient: Tensor, depth_gradient: Tensor | None) -> Tensor:
        source = self._make_source((image_gradient, None, depth_gradient), absolute=False)
        return camera_gradient(self._view.ranks, self._scene, source, blocks=self._blocks)

    def step(
        self,
        adam: FusedAdam,
        image_gradient: Tensor,
        depth_gradient: Tensor | None,
        observe: bool,
        absolute: bool = False,
        now: None = None,
        camera: Tensor | None = None,
    ) -> None:
        """Take Adam's step with the gradients of an image (3, H, W) and of inverse depth (1, H, W).

        observe: add the view to the statistics of density control; absolute: with sums of absolute gradients. camera:
        receives the gradient by the camera's numbers.
        """
        absolute &= observe
        source = self._make_source((image_gradient, None, depth_gradient), absolute)
        if camera is not None:
            found = camera_gradient(self._view.ranks, self._scene, source, absolute, self._blocks)
            camera[: len(found)] = found
        adam.apply(self._scene, source, (), self.radii, observe, absolute, now, awake=self._awake)

    def _make_source(self, planes: tuple[Tensor | None, ...], absolute: bool) -> tuple[Tensor, ...]:
        view = self._view
        return view.splats, view.tile_counts, *gradient_rows(view, planes, absolute)
