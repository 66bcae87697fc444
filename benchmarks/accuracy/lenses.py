"""Error of lenses: against mpmath and pycolmap, of float32 against float64, of EWA and of rays.

    python -m benchmarks.accuracy.lenses --device cpu   # or on the GPU, if there is one

The first table judges the kernels' float64 on Gaussians over a lens's whole field: the pixels of their means, px, and
first and second derivatives, by those of 40 digits (mpmath), then pixels and slopes by pycolmap's. A derivative's error
is relative to the largest one of its point, all as if the point were 1 away. Second derivatives are those of
projection's backward. The second table has float32 against float64: pixels, then image and gradients by EWA and on
rays, over the largest value of their tensor, of a weighted sum of the image. The third has one Gaussian of opacity 0.9
whose standard deviation is so many degrees, off the axis of an equidistant fisheye and of a pinhole. An exact ray has
the alpha opacity * exp(-D^2 / 2), D the ray's least distance from the mean in standard deviations: a Gaussian's largest
value on a ray, and as well its integral along the ray over that along a parallel one through the mean. EWA takes the
lens's Jacobian at the mean instead (Zwicker et al. 2001); projection="ray" differs by the dilation alone. Kernels draw
both, in float64 on a CPU. Shown are the largest difference of alpha, and the sum of differences over the sum of alphas.
"""

import argparse
import math

import mpmath
import numpy as np
import pycolmap
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, Gaussians, rasterize
from diff_gaussian_rasterization.backend import OPERATORS
from diff_gaussian_rasterization.lens import Lens, lens_of
from diff_gaussian_rasterization.scene import scene_arguments
from torch import Tensor

from benchmarks.harness.measuring import add_device, choose_device, describe_machine, print_table
from utils.system_utils import run_cli

_WIDTH, _HEIGHT, _COUNT, _EXACT, _DEGREE = 640, 480, 2000, 200, math.pi / 180
# COLMAP's parameters behind focal lengths and principal point: each moves a corner by a twentieth or more.
_EXTRAS: dict[str, tuple[float, ...]] = {
    "PINHOLE": (),
    "SIMPLE_RADIAL": (-0.15,),
    "RADIAL": (-0.15, 0.02),
    "OPENCV": (-0.15, 0.02, 0.003, -0.002),
    "FULL_OPENCV": (-0.15, 0.02, 0.003, -0.002, 0.01, 0.02, -0.01, 0.005),
    "SIMPLE_RADIAL_FISHEYE": (0.05,),
    "RADIAL_FISHEYE": (0.05, -0.01),
    "OPENCV_FISHEYE": (0.05, -0.01, 0.003, -0.001),
    "THIN_PRISM_FISHEYE": (0.02, -0.01, 0.001, -0.001, 0.003, -0.001, 0.001, -0.001),
}
_PANORAMA = Lens("equirectangular", (_WIDTH / (2 * math.pi), _HEIGHT / math.pi), (_WIDTH / 2 - 0.5, _HEIGHT / 2 - 0.5))
_ANGLES = {"equidistant": (0, 10, 60, 90, 120, 170), "perspective": (0, 10, 30, 60)}  # degrees
_SHAPES = ((0.2, 0.2, 0.2), (1.0, 1.0, 1.0), (5.0, 5.0, 5.0), (5.0, 0.2, 0.2))  # degrees


def make_camera(
    lens: Lens, dtype: torch.dtype, device: str, width: int = _WIDTH, height: int = _HEIGHT, projection: str = "ewa"
) -> GaussianRasterizationSettings:
    """Settings of a camera at the origin."""
    eye, zero = torch.eye(4, dtype=dtype, device=device), torch.zeros(3, dtype=dtype, device=device)
    plain = GaussianRasterizationSettings(
        height, width, 1.0, 1.0, zero, 1.0, eye, eye, 3, zero, False, False, lens=lens
    )
    return plain._replace(projection=projection)


def half_field(lens: Lens) -> float:
    """Half the angle that a lens shows, radians."""
    field = lens.field(_WIDTH, _HEIGHT)
    return math.atan(field) if lens.chart == "perspective" else min(field, math.pi - 0.1)


def make_spread(lens: Lens) -> dict[str, Tensor]:
    """Gaussians all over a lens's field, float32 values as float64."""
    rng, draw = np.random.default_rng(0), torch.Generator().manual_seed(0)
    theta = half_field(lens) * np.sqrt(rng.uniform(0, 1, _COUNT))
    phi, away = rng.uniform(0, 2 * math.pi, _COUNT), rng.uniform(1, 5, (_COUNT, 1))
    ray = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], 1)
    shapes = {"opacities": (1,), "scales": (3,), "rotations": (4,), "sh_dc": (1, 3), "sh_rest": (15, 3)}
    drawn = {"means": torch.from_numpy(ray * away)}
    drawn |= {name: torch.randn(_COUNT, *shape, generator=draw) for name, shape in shapes.items()}
    drawn["scales"] = 0.5 * drawn["scales"] + torch.log(0.02 * torch.from_numpy(away))
    return {name: values.float().double() for name, values in drawn.items()}


def draw_splats(
    lens: Lens, values: dict[str, Tensor], dtype: torch.dtype, device: str, projection: str = "ewa"
) -> tuple[Tensor, Tensor, list[Tensor]]:
    """The means' pixels where they are shown, else NaN, the image, and the gradients."""
    settings = make_camera(lens, dtype, device, projection=projection)
    leaves = {name: value.to(device, dtype).clone().requires_grad_() for name, value in values.items()}
    splats, _, _, counts, *_ = OPERATORS.project(*scene_arguments(Gaussians(**leaves), settings, True))
    pixels = torch.where(counts[:, None] > 0, splats[:, :2], math.nan)
    others = dict(leaves)
    means, opacities = others.pop("means"), others.pop("opacities")
    image = rasterize(means, torch.zeros_like(means), opacities, settings, raw=True, **others).color
    weight = torch.randn(image.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    (weight.to(image) * image).sum().backward()
    return pixels.double().cpu(), image.detach().double().cpu(), [leaf.grad.double().cpu() for leaf in leaves.values()]


def exact_row(name: str, lens: Lens) -> list[str]:
    """A row of the first table."""
    means = make_spread(lens)["means"]
    row = [name, f"{2 * half_field(lens) / _DEGREE:.0f}", *(f"{e:.1e}" for e in mpmath_errors(lens, means[:_EXACT]))]
    if name not in _EXTRAS:
        return [*row, "", ""]
    shown = pycolmap.Camera(model=name, width=_WIDTH, height=_HEIGHT, params=_make_params(name))
    theirs = torch.from_numpy(np.asarray(shown.img_from_cam(means.numpy()))) - 0.5
    pixels = (draw_splats(lens, make_spread(lens), torch.float64, "cpu")[0] - theirs).abs().nan_to_num(0).max()
    return [*row, f"{pixels:.1e}", f"{slopes_error(shown, lens, means.numpy()):.1e}"]


def single_row(name: str, lens: Lens, device: str) -> list[str]:
    """A row of the second table."""
    row, values = [name], make_spread(lens)
    for projection in ("ewa", "ray"):
        exact, single = (
            draw_splats(lens, values, *at, projection) for at in ((torch.float64, "cpu"), (torch.float32, device))
        )
        pixels, image = ((single[k] - exact[k]).abs().nan_to_num(0).max() for k in range(2))
        gradients = max((a - b).abs().max() / b.abs().max() for a, b in zip(single[2], exact[2], strict=True))
        row += [f"{pixels:.1e}"] * (projection == "ewa") + [f"{image:.1e}", f"{gradients:.1e}"]
    return row


def exact_pixel(lens: Lens, point: list) -> list:
    """Return the pixel at which a lens shows a point of the view, by COLMAP's formulas in mpmath's numbers.

    The formulas are those of Brown 1966 and Weng et al. 1992.
    """
    x, y, z = point
    r = mpmath.sqrt(x * x + y * y)
    if lens.chart == "perspective":
        a, b = x / z, y / z
    elif lens.chart == "equidistant":
        a, b = (t * mpmath.atan2(r, z) / r for t in (x, y))
    else:
        a, b = mpmath.atan2(x, z), mpmath.atan2(y, mpmath.sqrt(x * x + z * z))
    q, (p1, p2) = a * a + b * b, lens.tangential
    over, under = (1 + sum(c * q ** (k + 1) for k, c in enumerate(terms)) for terms in (lens.radial, lens.divisor))
    across = a * over / under + 2 * p1 * a * b + p2 * (q + 2 * a * a) + lens.prism[0] * q
    down = b * over / under + 2 * p2 * a * b + p1 * (q + 2 * b * b) + lens.prism[1] * q
    return [lens.focal[0] * across + lens.center[0], lens.focal[1] * down + lens.center[1]]


def exact_derivatives(lens: Lens, point: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The pixel (2,), J (2, 3) and second derivatives (2, 3, 3), by differences of 40 digits."""
    step, axes = mpmath.mpf(10) ** -12, range(3)

    def at(*moves: tuple[int, int]) -> np.ndarray:
        moved = [mpmath.mpf(float(c)) for c in point]
        for axis, sign in moves:
            moved[axis] += sign * step
        return np.array(exact_pixel(lens, moved))

    first = [(at((k, 1)) - at((k, -1))) / (2 * step) for k in axes]
    second = [
        [(at((k, 1), (m, 1)) - at((k, 1), (m, -1)) - at((k, -1), (m, 1)) + at((k, -1), (m, -1))) / (4 * step**2)
         for m in axes] for k in axes
    ]  # fmt: skip
    return at().astype(float), np.array(first).astype(float).T, np.array(second).astype(float).transpose(2, 0, 1)


def mpmath_errors(lens: Lens, means: Tensor) -> tuple[float, float, float]:
    """Largest errors of the kernels' pixels (px), and of first and second derivatives (relative), at means (N, 3).

    Derivatives are those that gradient rows of one moment bring to the means: of the mean's pixel, and of the
    covariance J S J^T + 0.3 I, whose S has one axis alone, by x and by y. Means off the image are left out.
    """
    mpmath.mp.dps = 40
    away = means.norm(dim=1).numpy()
    pixel, J, H = (np.array(t) for t in zip(*(exact_derivatives(lens, p) for p in means.numpy()), strict=True))
    count, log_size = len(means), math.log(0.2)
    worst = np.zeros(3)
    for axis in range(3):
        scales = torch.full((count, 3), -40.0, dtype=torch.float64)
        scales[:, axis] = log_size + torch.from_numpy(np.log(away))
        values = {"means": means, "opacities": torch.zeros(count, 1), "scales": scales}
        values |= {"rotations": torch.eye(4)[:1].repeat(count, 1), "sh_dc": torch.zeros(count, 1, 3)}
        values |= {"sh_rest": torch.zeros(count, 15, 3)}
        scene = scene_arguments(
            Gaussians(**{k: v.double() for k, v in values.items()}), make_camera(lens, torch.float64, "cpu"), True
        )
        splats, _, _, tiles, _ = OPERATORS.project(*scene)
        splats[tiles == 0] = 1  # undefined
        x, y, l11, l12, l22 = splats[:, :5].numpy().T
        l11 = np.abs(l11)  # negative where a splat crosses a panorama's border
        inside = (tiles.numpy() > 0) & (x >= 0) & (x < _WIDTH) & (y >= 0) & (y < _HEIGHT)
        size = np.exp(2 * scales[:, axis].numpy())
        worst[0] = max(worst[0], np.abs(np.stack([x, y], 1) - pixel)[inside].max())
        for k in range(2):
            # d log2(alpha) of the pixel is 2 L^T (u, v); that of the covariance is L^T (u, v) (u, v)^T L.
            u, v = (1 / l11, -l12 / l11 / l22) if k == 0 else (0 * l11, 1 / l22)
            rows = np.zeros((2, count, 10))
            rows[0, :, 1], rows[0, :, 2] = u / (2 * math.log(2)), v / (2 * math.log(2))
            rows[1, :, 3], rows[1, :, 4], rows[1, :, 5] = (t / (2 * math.log(2) ** 2) for t in (u * u, u * v, v * v))
            found = [
                OPERATORS.rasterize_vjp(
                    *scene, [name == 1 for name in range(9)],
                    [splats, tiles, torch.from_numpy(row)[tiles > 0], (tiles > 0).int()], None, None, None,
                )[1].numpy() for row in rows
            ]  # fmt: skip
            second = 2 * size[:, None] * J[:, k, axis, None] * H[:, k, :, axis]
            scale = 2 * size * np.abs(J[:, k, axis]) * np.abs(H[:, k]).max((1, 2)) + 1e-300
            errors = (
                np.abs(found[0] - J[:, k]).max(1) / np.abs(J[:, k]).max(1),
                np.abs(found[1] - second).max(1) / scale,
            )
            well = inside & (np.abs(J[:, k, axis]) > 1e-2 * np.abs(J[:, k]).max(1))  # else both are 0
            worst[1:] = np.maximum(worst[1:], [errors[0][inside].max(), errors[1][well].max(initial=0)])
    return tuple(worst)


def slopes_error(shown: pycolmap.Camera, lens: Lens, means: np.ndarray) -> float:
    """Largest relative error of J J^T, from the footprints of balls, against differences of pycolmap's pixels.

    means (N, 3): those in the image count, since beyond it J is that of a clamped ray.
    """
    step, away = 3e-4, np.linalg.norm(means, axis=1, keepdims=True)
    columns = []
    for axis in np.eye(3):
        at = [np.asarray(shown.img_from_cam(means + k * step * away * axis)) for k in (-2, -1, 1, 2)]
        columns.append((at[0] - 8 * at[1] + 8 * at[2] - at[3]) / (12 * step * away))
    theirs = np.stack(columns, 2) @ np.stack(columns, 1)
    count, size = len(means), 0.2 * away
    balls = {"means": means, "scales": np.log(size).repeat(3, 1), "rotations": np.eye(4)[:1].repeat(count, 0)}
    balls |= {"opacities": np.zeros((count, 1)), "sh_dc": np.zeros((count, 1, 3)), "sh_rest": np.zeros((count, 15, 3))}
    scene = Gaussians(**{name: torch.from_numpy(values) for name, values in balls.items()})
    splats, _, _, counts, *_ = OPERATORS.project(*scene_arguments(scene, make_camera(lens, torch.float64, "cpu"), True))
    x, y, a, b, c = splats[:, :5].numpy().T
    factor = np.stack([np.stack([a, b], 1), np.stack([0 * c, c], 1)], 1)
    inside = (x >= 0) & (x < _WIDTH) & (y >= 0) & (y < _HEIGHT) & (means[:, 2] > 0) & (counts.numpy() > 0)
    inside &= np.isfinite(theirs).all((1, 2))  # pycolmap shows nothing beyond where a distortion turns back
    spread = np.linalg.inv(2 * math.log(2) * factor[inside].swapaxes(1, 2) @ factor[inside])
    ours = (spread - 0.3 * np.eye(2)) / size[inside, :, None] ** 2
    return float((np.abs(ours - theirs[inside]).max((1, 2)) / np.trace(theirs[inside], axis1=1, axis2=2)).max())


def _make_params(model: str) -> list[float]:
    focals = 2 if model in {"PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE"} else 1
    focal = 180.0 if "FISHEYE" in model else 400.0
    return [*[focal] * focals, 330.0, 236.0, *_EXTRAS[model]]


def projection_errors(chart: str, angle: float, deviations: tuple[float, float, float]) -> list[tuple[float, float]]:
    """Largest difference of alpha, and the relative sum of differences, of EWA and of rays.

    angle: of the mean from the axis, degrees. deviations: of the Gaussian across (twice) and along the ray, degrees.
    """
    pixels, focal = 2048, 16 / _DEGREE  # 16 pixels a degree on the axis
    middle = focal * (math.tan(angle * _DEGREE) if chart == "perspective" else angle * _DEGREE)
    lens = Lens(chart, (focal, focal), (pixels / 2 - middle, pixels / 2))
    ray = np.array([math.sin(angle * _DEGREE), 0.0, math.cos(angle * _DEGREE)])
    axes = np.stack([np.array([ray[2], 0.0, -ray[0]]), np.array([0.0, 1.0, 0.0]), ray], 1)
    sizes = np.array(deviations) * _DEGREE
    y, x = np.mgrid[:pixels, :pixels]
    a, b = (x - lens.center[0]) / focal, (y - lens.center[1]) / focal
    if chart == "perspective":
        rays = np.stack([a, b, np.ones_like(a)], -1)
    else:
        theta = np.hypot(a, b)
        rays = np.stack([a * np.sinc(theta / np.pi), b * np.sinc(theta / np.pi), np.cos(theta)], -1)
        rays[theta > np.pi] = np.nan
    toward, origin = rays @ axes / sizes, -ray @ axes / sizes
    square = (np.cross(origin, toward) ** 2).sum(-1) / (toward**2).sum(-1)
    exact = np.nan_to_num(0.9 * np.exp(-0.5 * square) * (toward @ origin < 0))
    exact[exact < 1 / 255] = 0
    known = torch.from_numpy(np.isfinite(square))
    settings = make_camera(lens, torch.float64, "cpu", pixels, pixels)
    upper = torch.from_numpy((axes * sizes**2 @ axes.T)[np.triu_indices(3)])[None]
    mean, opacity = torch.from_numpy(ray)[None], torch.full((1, 1), 0.9, dtype=torch.float64)
    shape = {"cov3d": upper, "colors": torch.ones(1, 3, dtype=torch.float64)}
    found = []
    for projection in ("ewa", "ray"):
        drawn = rasterize(mean, 0 * mean, opacity, settings._replace(projection=projection), **shape)
        difference = np.abs((drawn.color[0] * known).numpy() - exact)
        found.append((float(difference.max()), float(difference.sum() / exact.sum())))
    return found


def main() -> None:
    """Print the errors of all lenses, then those of EWA and of rays against exact rays."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_device(parser)
    device = choose_device(parser.parse_args())
    print(describe_machine(device))
    lenses = {name: lens_of(name, tuple(_make_params(name))) for name in _EXTRAS} | {"panorama": _PANORAMA}
    header = ["lens", "degrees", "mpmath: pixels", "first", "second", "pycolmap: pixels", "slopes"]
    print_table(header, [exact_row(name, lens) for name, lens in lenses.items()])
    header = ["float32", "pixels", "ewa: image", "gradients", "ray: image", "gradients"]
    print_table(header, [single_row(name, lens, device) for name, lens in lenses.items()])
    print("\nEWA, then rays, against exact rays: largest difference of alpha, share of the sum")
    rows = []
    for chart, angles in _ANGLES.items():
        for angle in angles:
            found = [projection_errors(chart, angle, shape) for shape in _SHAPES]
            for k, name in enumerate(("ewa", "ray")):
                rows.append([chart, str(angle), name, *(f"{each[k][0]:.3f}, {each[k][1]:.1%}" for each in found)])
    print_table(["chart", "degrees off axis", "", "0.2 degrees", "1 degree", "5 degrees", "5 x 0.2 x 0.2"], rows)


if __name__ == "__main__":
    run_cli(main)
