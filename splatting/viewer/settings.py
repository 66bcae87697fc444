"""Settings of a frame, and the pose of a browser's camera, which is checked since it comes over the network."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import viser

COLOUR, DEPTH, OPACITY, COUNT, ERROR = MODES = ("Colour", "Depth", "Opacity", "Gaussians a pixel", "Error")
ALONE, SLIDER, BESIDE = COMPARISONS = ("Render alone", "Slider", "Side by side")

Vector = tuple[float, float, float]
_WIDEST = 8192  # pixels of a window's side
_SLIMMEST = 10  # ratio of its sides


@dataclass(frozen=True)
class Pose:
    """A camera of the page and the size of its window.

    position: world. wxyz: unit quaternion, camera axes (x right, y down, z forward) to world. fov: vertical, radians.
    """

    position: Vector
    wxyz: tuple[float, float, float, float]
    fov: float
    width: int
    height: int


@dataclass(frozen=True)
class Settings:
    """mode: of MODES. scaling: factor of all scales. sh_degree: highest that is drawn. background: RGB in [0, 1].

    crop: opposite corners of the box outside of which nothing is drawn, world coordinates, or None. camera: name of the
    chosen camera, None: none. comparison: of COMPARISONS. slider: share of the image's width that is the photo.
    """

    mode: str = COLOUR
    scaling: float = 1.0
    sh_degree: int = 3
    background: Vector = (0.0, 0.0, 0.0)
    crop: tuple[Vector, Vector] | None = None
    camera: str | None = None
    comparison: str = ALONE
    slider: float = 0.5


def pose_of(camera: "viser.CameraHandle") -> Pose | None:
    """The pose and window of a browser's camera, None for one that cannot be drawn."""
    position, wxyz = [float(x) for x in camera.position], [float(x) for x in camera.wxyz]
    fov, length = float(camera.fov), math.hypot(*wxyz)
    if not all(map(math.isfinite, (*position, *wxyz, fov))) or not 0 < fov < math.pi or not 1e-6 < length < 1e6:
        return None
    return Pose(tuple(position), tuple(x / length for x in wxyz), fov, *window_of(camera))


def window_of(camera: "viser.CameraHandle") -> tuple[int, int]:
    """Width and height, in pixels, of a browser's window; sides that cannot be drawn count as the nearest that can."""
    width, height = (min(max(int(side), 1), _WIDEST) for side in (camera.image_width, camera.image_height))
    return max(width, height // _SLIMMEST), max(height, width // _SLIMMEST)


def as_utf8(text: str) -> str:
    """A text that can be sent: names of files that are not UTF-8 have surrogates, which appear as numbers."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")
