"""Stiff and extreme cases for the rasterizer: scene, camera, the largest error allowed, and the reason for that bound.

Each scene has ordinary Gaussians and some of the case's kind, which are called stiff. If the camera is the extreme
part, all Gaussians count as stiff. benchmarks/accuracy/stability.py measures the cases; its test holds them to their
bounds.
"""

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, Gaussians
from torch import Generator, Tensor

from tests.workloads.splat_scenes import PARAMETERS, frustum, settings
from tests.workloads.textbook import make_covariances

WIDTH, HEIGHT = 75, 53  # no multiple of the tile
ORDINARY = 40  # Gaussians
Parameters = dict[str, Tensor]


@dataclass(frozen=True)
class Problem:
    """The tensors of one case."""

    parameters: Parameters  # raw, float32 (cov3d and the like: see `raw`)
    camera: GaussianRasterizationSettings  # float64
    stiff: Tensor  # (N,) bool
    absent: Tensor  # (N,) bool: not finite, so results must be as if these Gaussians did not exist
    raw: bool = True


@dataclass(frozen=True)
class Bound:
    """Largest errors allowed for CPU float32, as stability.py defines them, and the reason in a sentence."""

    image: float
    gradient: float
    reason: str


@dataclass(frozen=True)
class Case:
    group: str
    name: str
    make: Callable[[Generator], Problem]
    bound: Bound
    double: float = 1e-12  # largest error of any kind allowed for CPU float64
    cut: float = 1e-4  # pixels this near to a cut-off (relative) do not count

    def problem(self) -> Problem:
        return self.make(Generator().manual_seed(zlib.crc32(self.name.encode())))


# ---- scenes ----


def camera(width: int = WIDTH, height: int = HEIGHT, **changes) -> GaussianRasterizationSettings:
    """Make a pinhole camera in float64; `changes` are those of `settings`."""
    return settings(width, height, **changes)


def normal(g: Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=g, dtype=torch.float64)


def uniform(g: Generator, low: float, high: float, *shape: int) -> Tensor:
    return low + (high - low) * torch.rand(*shape, generator=g, dtype=torch.float64)


def anywhere(g: Generator, n: int, cam: GaussianRasterizationSettings | None = None) -> Tensor:
    """Draw pixels (n, 2) of the image."""
    size = (cam.image_width, cam.image_height) if cam else (WIDTH, HEIGHT)
    return uniform(g, 0, 1, n, 2) * torch.tensor(size)


def place_means(pixel: Tensor, depth: Tensor, cam: GaussianRasterizationSettings) -> Tensor:
    """Return means (n, 3) in the view's frame that project to pixels (n, 2) at depths (n,)."""
    size = torch.tensor([cam.image_width, cam.image_height], dtype=torch.float64)
    ndc = (2 * pixel + 1) / size - 1
    ray = ndc * torch.tensor([cam.tanfovx, cam.tanfovy])
    return torch.cat([ray, torch.ones_like(ray[:, :1])], 1) * depth[:, None]


def splats(
    g: Generator, n: int, *, sigma: Tensor | float = 3.0, scales: Tensor | None = None, cam=None, **given: Tensor
) -> Parameters:
    """Make n Gaussians over the image at depths 2 to 6.

    sigma: px, (n, 3), or the centre of random ones; scales: world units, instead of sigma. given: means, rotations and
    logits, in place of random ones.
    """
    cam = cam or camera()
    means = given["means"] if "means" in given else place_means(anywhere(g, n, cam), uniform(g, 2, 6, n), cam)
    if scales is None:
        if not isinstance(sigma, Tensor):
            sigma = sigma * normal(g, n, 3).mul(0.4).exp()
        scales = sigma * means[:, 2:].abs() * (2 * cam.tanfovx / cam.image_width)
    logits = given["logits"].reshape(n, 1) if "logits" in given else normal(g, n, 1)
    made = {"means": means, "opacities": logits, "scales": torch.log(scales.double()).expand(n, 3)}
    made["rotations"] = given["rotations"] if "rotations" in given else normal(g, n, 4)
    made |= {"sh_dc": 0.8 * normal(g, n, 1, 3), "sh_rest": 0.1 * normal(g, n, 15, 3)}
    return {name: t.float().contiguous() for name, t in made.items()}


def among_ordinary(stiff: Parameters, cam=None, absent: Tensor | None = None) -> Problem:
    """Make a problem of ordinary Gaussians followed by the stiff ones."""
    ordinary = frustum(ORDINARY, WIDTH, HEIGHT, 3.0, seed=1).parameters
    n = len(stiff["means"])
    before = torch.zeros(ORDINARY, dtype=torch.bool)
    is_absent = torch.zeros(n, dtype=torch.bool) if absent is None else absent
    parameters = {name: torch.cat([ordinary[name], stiff[name]]) for name in PARAMETERS}
    is_stiff = torch.cat([before, torch.ones(n, dtype=torch.bool)])
    return Problem(parameters, cam or camera(), is_stiff, torch.cat([before, is_absent]))


def all_stiff(parameters: Parameters, cam: GaussianRasterizationSettings, raw: bool = True) -> Problem:
    n = len(parameters["means"])
    return Problem(parameters, cam, torch.ones(n, dtype=torch.bool), torch.zeros(n, dtype=torch.bool), raw)


ANTIALIASED = camera(antialiasing=True)


def axes(n: int, *sigma: float) -> Tensor:
    return torch.tensor(sigma, dtype=torch.float64).expand(n, 3)


# ---- bounds ----

PLAIN = Bound(5e-6, 1e-5, "sums of some 50 terms, each rounded a few times; the case itself adds no error")
STEEP = Bound(
    5e-6, 3e-5, "flanks of half a pixel: a rounding of the mean, 4e-6 px, moves u as much; few pixels average it out"
)
LONG = Bound(3e-4, 3e-3, "a needle turned by one rounding of its quaternion moves its end by 1e-4 px: conditioning")
LONGEST = Bound(1e-2, 6e-2, "as above, a hundred times longer; parts thinner than their end's rounding are mostly cut")
GIVEN = Bound(
    2e-2, 4e-2, "float32 covariances hold no needle: rounding moves short axes by 0.06 px^2; negative ones count as 0"
)
STRETCHED = Bound(6e-5, 3e-5, "opaque needles up to 5,000 px: one rounding of the inputs moves the image by 1e-5")
ELSEWHERE = Bound(
    5e-6, 1e-5, "differences of coordinates are exact while the camera is not turned; one rounding is the image"
)
STACKED = Bound(5e-6, 5e-6, "some 2,300 blends, each rounding T once; back to front nothing is subtracted")
LARGE = Bound(6e-5, 1e-4, "pixel coordinates of 16,384 have steps of 1e-3")
TELE = Bound(1e-1, 2e-1, "a focal length of 4e6 px: one rounding of a rotation or a mean is 0.3 px")
OBLIQUE = Bound(1e-5, 3e-5, "rays of 100 to the axis: a rounding of z counts a hundredfold")
NOTHING = Bound(1e-7, 0, "the background, rounded to float32")
ABSENT = Bound(5e-6, 0, "as if the Gaussian were not there")

# ---- shape ----


def needles(ratio: float, cam: GaussianRasterizationSettings | None = None) -> Callable[[Generator], Problem]:
    return lambda g: among_ordinary(splats(g, 30, sigma=axes(30, 30, 30 / ratio, 30 / ratio)), cam)


def pancakes(ratio: float, cam: GaussianRasterizationSettings | None = None) -> Callable[[Generator], Problem]:
    return lambda g: among_ordinary(splats(g, 30, sigma=axes(30, 30, 30, 30 / ratio)), cam)


def turn_x_to(direction: Tensor) -> Tensor:
    """Return quaternions (n, 4) that turn the first axis to unit directions (n, 3)."""
    x = torch.tensor([1.0, 0, 0], dtype=torch.float64).expand_as(direction)
    return torch.cat([1 + direction[:, :1], torch.linalg.cross(x, direction)], 1)


def long_needles(
    n: int, low: float, high: float, width_px: tuple[float, float] = (1e-3, 3)
) -> tuple[Callable[[Generator], Parameters], GaussianRasterizationSettings]:
    """Make needles of sigma low to high px, parallel to the image up to a hundredth, and a camera.

    The part of a needle in the image is anywhere within 2.5 sigma of its mean.
    """
    cam = camera(128, 96)

    def make(g: Generator) -> Parameters:
        length = low * (high / low) ** uniform(g, 0, 1, n)
        thin = width_px[0] * (width_px[1] / width_px[0]) ** uniform(g, 0, 1, n, 2)
        angle = uniform(g, 0, 2 * math.pi, n)
        across = torch.stack([angle.cos(), angle.sin()], 1)
        pixel = uniform(g, 0.1, 0.9, n, 2) * torch.tensor([cam.image_width, cam.image_height])
        pixel = pixel - (uniform(g, -2.5, 2.5, n) * length)[:, None] * across
        direction = torch.nn.functional.normalize(torch.cat([across, 0.01 * normal(g, n, 1)], 1))
        means = place_means(pixel, uniform(g, 2, 6, n), cam)
        sigma = torch.cat([length[:, None], thin], 1)
        return splats(g, n, sigma=sigma, means=means, rotations=turn_x_to(direction), cam=cam)

    return make, cam


def make_needles(low: float, high: float) -> Callable[[Generator], Problem]:
    make, cam = long_needles(30, low, high)
    return lambda g: all_stiff(make(g), cam)


def needles_as_covariances(g: Generator) -> Problem:
    make, cam = long_needles(30, 100, 1000)
    raw = make(g)
    rotations = torch.nn.functional.normalize(raw["rotations"].double())
    gaussians = Gaussians(raw["means"], raw["opacities"], raw["scales"].double().exp(), rotations)
    full = make_covariances(gaussians, 1.0)[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    given = {"means": raw["means"], "opacities": raw["opacities"].sigmoid(), "cov3d": full.float()}
    return all_stiff(given | {"colors": uniform(g, 0, 1, 30, 3).float()}, cam, raw=False)


def edge_on(cam: GaussianRasterizationSettings) -> Callable[[Generator], Problem]:
    """Make pancakes whose plane contains the camera, so that their undilated determinant is that of a line."""

    def make(g: Generator) -> Problem:
        n = 30
        means = place_means(anywhere(g, n), uniform(g, 2, 6, n), camera())
        thin = turn_x_to(torch.nn.functional.normalize(torch.linalg.cross(means, normal(g, n, 3))))
        return among_ordinary(splats(g, n, sigma=axes(n, 1e-3, 20, 20), means=means, rotations=thin, cam=cam), cam)

    return make


def make_sized(sigma: float = 1.0, world: float | None = None, faint: float = 0.0) -> Callable[[Generator], Problem]:
    def make(g: Generator) -> Problem:
        scales = None if world is None else world * normal(g, 30, 3).mul(0.4).exp()
        return among_ordinary(splats(g, 30, sigma=sigma, scales=scales, logits=normal(g, 30) - faint))

    return make


def round_ones(g: Generator) -> Problem:
    return among_ordinary(splats(g, 30, sigma=axes(30, 4, 4, 4)))


def stretched(
    length: tuple[float, float], ratio: tuple[float, float], logit: tuple = (-2, 2), depth: tuple = (2, 6)
) -> Callable[[Generator], Problem]:
    """Make needles, pancakes and what lies between, as in trained models: sigma px, axis ratio, logit, depth."""

    def make(g: Generator) -> Problem:
        n = 200

        def between(low: float, high: float) -> Tensor:
            return low * (high / low) ** uniform(g, 0, 1, n)

        longest, by = between(*length), between(*ratio)
        sigma = torch.stack([longest, longest / by ** uniform(g, 0, 1, n), longest / by], 1)
        means = place_means(anywhere(g, n), between(*depth), camera())
        return among_ordinary(splats(g, n, sigma=sigma, means=means, logits=uniform(g, *logit, n)))

    return make


SHAPE = [
    *(Case("shape", f"needles, axes 1 : {ratio:.0e}", needles(ratio), STEEP) for ratio in (1e2, 1e4, 1e7)),
    *(Case("shape", f"pancakes, axes 1 : {ratio:.0e}", pancakes(ratio), PLAIN) for ratio in (1e2, 1e4, 1e7)),
    Case("shape", "needles 1 : 1e+07, antialiased", needles(1e7, ANTIALIASED), STEEP),
    Case("shape", "pancakes 1 : 1e+04, antialiased", pancakes(1e4, ANTIALIASED), PLAIN),
    Case("shape", "pancakes edge-on, antialiased", edge_on(ANTIALIASED), STEEP),
    Case("shape", "scales of 1e-10", make_sized(world=1e-10), STEEP),
    Case("shape", "scales of 1e6", make_sized(world=1e6, faint=2), PLAIN),
    Case("shape", "three equal scales", round_ones, PLAIN),
    Case("shape", "a thousandth of a pixel", make_sized(sigma=1e-3), STEEP),
    Case("shape", "a thousand images wide", make_sized(sigma=1e3 * WIDTH, faint=2), PLAIN),
    Case("shape", "needles of 300 to 2,000 px", make_needles(300, 2000), LONG, double=1e-11, cut=2e-3),
    Case("shape", "conics of condition 1e7", make_needles(1700, 1760), LONG, double=1e-11, cut=2e-3),
    Case("shape", "needles of 1e4 to 1e6 px", make_needles(1e4, 1e6), LONGEST, double=1e-10, cut=0.1),
    Case("shape", "needles of 100 to 1,000 px as covariances", needles_as_covariances, GIVEN, double=2e-2, cut=2e-3),
    # What trained models have besides (benchmarks.accuracy.census).
    Case("shape", "stretched, 0.05 to 10 px", stretched((0.05, 10), (10, 1e6)), PLAIN),
    Case("shape", "stretched, opaque", stretched((0.3, 100), (1, 1e6), logit=(4.6, 14), depth=(0.21, 6)), STRETCHED),
    Case("shape", "stretched, faint", stretched((0.3, 100), (1, 1e6), logit=(-5.5, -2.2), depth=(0.21, 6)), PLAIN),
    Case("shape", "stretched, far", stretched((0.3, 5000), (1, 1e6), logit=(-5.5, 14), depth=(10, 1e4)), STRETCHED),
    Case("shape", "stretched, flat", stretched((0.05, 1000), (1e6, 1e11), logit=(-5.5, 5), depth=(2, 1e4)), STRETCHED),
]

# ---- place ----


def make_depths(*depths: float) -> Callable[[Generator], Problem]:
    def make(g: Generator) -> Problem:
        z = torch.tensor(depths).double().repeat_interleave(4)
        means = place_means(anywhere(g, len(z)), z, camera())
        return among_ordinary(splats(g, len(z), means=means))

    return make


def make_rays(low: float, high: float, depth: tuple[float, float], size: float) -> Callable[[Generator], Problem]:
    """Place means low to high half images from the axis; scales are `size` times the distance from the axis."""

    def make(g: Generator) -> Problem:
        n = 24
        off = low * (high / low) ** uniform(g, 0, 1, n)
        angle = uniform(g, 0, 2 * math.pi, n)
        cam = camera()
        z = uniform(g, *depth, n)
        ray = torch.stack([off * angle.cos() * cam.tanfovx, off * angle.sin() * cam.tanfovy], 1)
        means = torch.cat([ray * z[:, None], z[:, None]], 1)
        scales = size * ray.norm(dim=1, keepdim=True) * z[:, None] * normal(g, n, 3).mul(0.3).exp()
        return among_ordinary(splats(g, n, means=means, scales=scales))

    return make


def at_the_clamp(g: Generator) -> Problem:
    """Place means on both sides of the clamp, rays at 1.3 half images, relative distance 1e-5 and 1e-2."""
    cam = camera()
    by = torch.tensor([1 - 1e-2, 1 - 1e-5, 1 + 1e-5, 1 + 1e-2]).double().repeat_interleave(8)
    n = len(by)
    z = uniform(g, 2, 6, n)
    sign = torch.where(torch.rand(n, generator=g) < 0.5, -1.0, 1.0)
    clamped, free = 1.3 * by * sign, uniform(g, -1.2, 1.2, n)
    horizontal = torch.arange(n) % 2 == 0
    ray_x = torch.where(horizontal, clamped, free) * cam.tanfovx
    ray_y = torch.where(horizontal, free, clamped) * cam.tanfovy
    means = torch.stack([ray_x * z, ray_y * z, z], 1)
    return among_ordinary(splats(g, n, sigma=12.0, means=means))


def far_from_the_origin(g: Generator) -> Problem:
    """Move world and camera to coordinates of a map projection."""
    made = splats(g, 40)
    offset = torch.tensor([5e5, 4e6, 300.0], dtype=torch.float64)
    view = torch.eye(4, dtype=torch.float64)
    view[:3, 3] = -offset
    return all_stiff(made | {"means": (made["means"].double() + offset).float()}, camera(view=view))


def in_the_dark(g: Generator) -> Problem:
    """Place means behind the camera, in its plane, on it, and a thousandth of a unit around it; all are culled."""
    means = torch.cat([normal(g, 8, 3) * 1e-3, normal(g, 8, 3), torch.zeros(2, 3, dtype=torch.float64)])
    means[8:16, 2] = -means[8:16, 2].abs()
    means[12:16, 2] = 0
    return among_ordinary(splats(g, len(means), means=means, scales=torch.full((len(means), 3), 0.1)))


def nextafter(value: float, steps: int) -> float:
    t = torch.tensor(value)
    for _ in range(abs(steps)):
        t = torch.nextafter(t, torch.tensor(math.copysign(math.inf, steps)))
    return float(t)


NEAR = [nextafter(0.2, steps) for steps in (-1, 1, 2)]
PLACE = [
    Case("place", "at the near plane", make_depths(0.19999, *NEAR, 0.20001, 0.201, 0.25), PLAIN),
    Case("place", "behind, on and around the camera", in_the_dark, ABSENT),
    Case("place", "1e7 units away", make_depths(1e5, 1e6, 1e7), PLAIN),
    Case("place", "1e6 units from the origin", far_from_the_origin, ELSEWHERE, double=1e-8),
    Case("place", "at the limit of the Jacobian's ray", at_the_clamp, PLAIN),
    Case("place", "3 to 1,000 half images aside", make_rays(3, 1e3, (1, 4), 0.5), PLAIN),
    Case("place", "beside and above the camera", make_rays(20, 200, (0.2001, 0.22), 0.5), PLAIN),
]

# ---- opacity and blending ----


def make_logits(logits: Tensor) -> Callable[[Generator], Problem]:
    return lambda g: among_ordinary(splats(g, len(logits), sigma=4.0, logits=logits.double()))


def at_alpha(alpha: float) -> Callable[[Generator], Problem]:
    """Make splats whose alpha at a pixel's centre is `alpha` within ulps; opacities are given activated."""

    def make(g: Generator) -> Problem:
        problem = among_ordinary(splats(g, 17, sigma=4.0))
        p = dict(problem.parameters)
        pixel = torch.stack([4 + 4 * torch.arange(17), 3 + 3 * torch.arange(17) % 50], 1).double()
        p["means"][ORDINARY:] = place_means(pixel, uniform(g, 2, 6, 17), problem.camera).float()
        p["opacities"] = p["opacities"].sigmoid()
        p["opacities"][ORDINARY:, 0] = torch.tensor([nextafter(alpha, k) for k in range(-8, 9)])
        p["scales"] = p["scales"].exp()
        p["rotations"] = torch.nn.functional.normalize(p["rotations"])
        return Problem(p, problem.camera, problem.stiff, problem.absent, raw=False)

    return make


def one_pixel_stack(g: Generator) -> Problem:
    """Stack 50,000 wide splats over one pixel, each with alpha a little over 1/255; some 2,300 of them blend."""
    n = 50_000
    cam = camera(1, 1)
    alpha = uniform(g, 1.005, 1.05, n) / 255
    depth = torch.linspace(2, 6, n, dtype=torch.float64)[torch.randperm(n, generator=g)]
    means = place_means(uniform(g, -0.1, 0.1, n, 2), depth, cam)
    return all_stiff(splats(g, n, sigma=30.0, means=means, logits=torch.log(alpha / (1 - alpha)), cam=cam), cam)


def many_opaque(g: Generator) -> Problem:
    """Make 200 wide splats of alpha 0.05 to 0.99, so that every pixel becomes opaque."""
    alpha = uniform(g, 0.05, 0.99, 200)
    return among_ordinary(splats(g, 200, sigma=25.0, logits=torch.log(alpha / (1 - alpha))))


def tied(g: Generator, equal: bool) -> Problem:
    """Make thirty Gaussians at one depth; if `equal`, ten different ones three times."""
    means = place_means(anywhere(g, 10), torch.full((10,), 3.0), camera())
    if not equal:
        return among_ordinary(splats(g, 30, sigma=8.0, means=torch.cat([means, means + 0.0, means]).roll(1, 0)))
    made = splats(g, 10, sigma=8.0, means=means)
    return among_ordinary({name: t.repeat(3, *[1] * (t.dim() - 1)) for name, t in made.items()})


OPACITY = [
    Case("opacity", "logits from -50 to 50", make_logits(torch.linspace(-50, 50, 41)), PLAIN),
    Case("opacity", "infinite logits", make_logits(torch.tensor([math.inf, -math.inf, math.inf, -math.inf])), PLAIN),
    Case("opacity", "alpha 0.99 within ulps", at_alpha(0.99), PLAIN),
    Case("opacity", "alpha 1/255 within ulps", at_alpha(1 / 255), PLAIN),
    Case("opacity", "50,000 splats on one pixel", one_pixel_stack, STACKED),
    Case("opacity", "transmittance down to the stop", many_opaque, PLAIN),
    Case("opacity", "depth ties", lambda g: tied(g, False), PLAIN, cut=0.0),
    Case("opacity", "equal splats", lambda g: tied(g, True), PLAIN, cut=0.0),
]

# ---- rotation and colour ----


def with_quaternions(length: float) -> Callable[[Generator], Problem]:
    return lambda g: among_ordinary(splats(g, 20, sigma=axes(20, 2, 6, 12), rotations=length * normal(g, 20, 4)))


def bright(g: Generator) -> Problem:
    made = splats(g, 20, sigma=4.0)
    return among_ordinary(made | {name: 1e4 * made[name] for name in ("sh_dc", "sh_rest")})


def on_the_centre(g: Generator) -> Problem:
    """Put `campos` on the mean of a visible Gaussian, so that its viewing direction has length 0."""
    made = splats(g, 1, sigma=4.0)
    cam = camera(campos=made["means"][0].double())
    return among_ordinary(made, cam)


COLOR = [
    Case("rotation and colour", "zero quaternions", with_quaternions(0.0), PLAIN),
    Case("rotation and colour", "denormal quaternions", with_quaternions(1e-42), PLAIN),
    Case("rotation and colour", "quaternions of length 1e-20", with_quaternions(1e-20), PLAIN),
    Case("rotation and colour", "quaternions of length 1e20", with_quaternions(1e20), PLAIN),
    Case("rotation and colour", "SH coefficients of 1e4", bright, PLAIN),
    Case("rotation and colour", "viewing direction of no length", on_the_centre, PLAIN),
]

# ---- camera ----

TURNED = torch.eye(4, dtype=torch.float64)
TURNED[:3, :3] = torch.linalg.qr(torch.tensor([[0.9, 0.3, -0.2], [-0.1, 1.0, 0.5], [0.4, -0.6, 0.8]]).double()).Q
TURNED[:3, 3] = torch.tensor([0.7, -0.4, 1.1])


def seen_by(n: int, cam: GaussianRasterizationSettings, sigma: float = 3.0) -> Callable[[Generator], Problem]:
    """Place ordinary Gaussians in front of an extreme camera."""

    def make(g: Generator) -> Problem:
        made = splats(g, n, sigma=sigma, cam=cam)
        shift = torch.linalg.inv(cam.viewmatrix) @ cam.projmatrix
        offset = shift[2, :2] * torch.tensor([cam.tanfovx, cam.tanfovy])  # of the image's rays
        view = cam.viewmatrix.T
        local = made["means"].double()
        local[:, :2] -= offset * local[:, 2:]
        return all_stiff(made | {"means": ((local - view[:3, 3]) @ view[:3, :3]).float()}, cam)

    return make


NARROW, WIDE = math.radians(1e-3), math.radians(179)
CAMERA = [
    Case("camera", "one pixel", seen_by(40, camera(1, 1)), PLAIN),
    Case("camera", "16,384 x 5 px", seen_by(20, camera(16384, 5), sigma=20), LARGE),
    Case("camera", "17 x 31 px", seen_by(60, camera(17, 31)), PLAIN),
    Case("camera", "field of view 0.001 degrees", seen_by(60, camera(fov=NARROW)), PLAIN),
    Case(
        "camera", "field of view 0.001 degrees, turned", seen_by(60, camera(fov=NARROW, view=TURNED)), TELE, double=1e-9
    ),
    Case("camera", "field of view 179 degrees", seen_by(60, camera(fov=WIDE)), PLAIN),
    Case("camera", "field of view 179 degrees, turned", seen_by(60, camera(fov=WIDE, view=TURNED)), OBLIQUE),
    Case("camera", "principal point outside", seen_by(60, camera(principal=(3.0, -2.0))), PLAIN),
    Case("camera", "focal lengths 100 : 1", seen_by(60, camera(tan_ratio=100)), PLAIN),
    Case("camera", "focal lengths 1 : 100", seen_by(60, camera(tan_ratio=0.01)), PLAIN),
]

# ---- counts ----


def all_culled(g: Generator) -> Problem:
    made = splats(g, 20)
    return all_stiff(made | {"means": -made["means"]}, camera())


COUNTS = [
    Case("counts", "none", lambda g: all_stiff(splats(g, 0), camera()), NOTHING),
    Case("counts", "one", lambda g: all_stiff(splats(g, 1), camera()), PLAIN),
    Case("counts", "all culled", all_culled, NOTHING),
]

# ---- NaN and Inf ----


def make_poisoned(name: str, value: float) -> Callable[[Generator], Problem]:
    def make(g: Generator) -> Problem:
        made = splats(g, 6, sigma=6.0)
        made[name].view(6, -1)[:, 0] = value
        made[name][3:] = value
        return among_ordinary(made, absent=torch.ones(6, dtype=torch.bool))

    return make


NOT_FINITE = [
    Case("not finite", f"{value} in {name}", make_poisoned(name, value), ABSENT)
    for name in PARAMETERS
    for value in (math.nan, math.inf)
    if (name, value) != ("opacities", math.inf)
]

CASES = [*SHAPE, *PLACE, *OPACITY, *COLOR, *CAMERA, *COUNTS, *NOT_FINITE]
