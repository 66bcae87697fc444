"""Settings of a frame: the wishes of the page's controls, and the pose of a camera."""

from dataclasses import dataclass

COLOUR, DEPTH, OPACITY, COUNT, ERROR = MODES = ("Colour", "Depth", "Opacity", "Gaussians a pixel", "Error")
ALONE, SLIDER, BESIDE = COMPARISONS = ("Render alone", "Slider", "Side by side")

Vector = tuple[float, float, float]


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
    chosen camera, None: none. comparison: of COMPARISONS. slider: share of the picture's width that is the photo.
    """

    mode: str = COLOUR
    scaling: float = 1.0
    sh_degree: int = 3
    background: Vector = (0.0, 0.0, 0.0)
    crop: tuple[Vector, Vector] | None = None
    camera: str | None = None
    comparison: str = ALONE
    slider: float = 0.5
