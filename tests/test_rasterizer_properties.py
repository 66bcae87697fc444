"""Properties that hold for every scene, tried on drawn ones.

GS_FUZZ=2000 in the environment draws that many scenes for each property.
"""

import math
import os

import torch
from hypothesis import HealthCheck, given
from hypothesis import settings as budget
from hypothesis import strategies as st
from rasterizer_tools import gradients, pick, render, rigid, rotation_matrix
from torch import Tensor

from benchmarks.workloads.splat_scenes import SplatScene, frustum, settings

SEEDS = st.integers(0, 2**31 - 1)
UNIT = st.floats(-1, 1, width=32)
QUATERNIONS = st.tuples(UNIT, UNIT, UNIT, UNIT).filter(lambda q: sum(x * x for x in q) > 0.01)
FUZZ = int(os.environ.get("GS_FUZZ", "0"))
SHORT = budget(max_examples=FUZZ or 15, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
MANY = budget(SHORT, max_examples=FUZZ or 150)
WIDTH, HEIGHT = 64, 48


def scene(seed: int, n: int = 60, sigma_px: float = 2.0) -> dict[str, Tensor]:
    made: SplatScene = frustum(n, WIDTH, HEIGHT, sigma_px, seed)
    return {name: t.double() for name, t in made.parameters.items()}


@SHORT
@given(seed=SEEDS, cut=st.sampled_from([16, 32, 48, 23, 40]))
def test_two_parts_of_an_image_are_the_whole(seed, cut):
    """A crop is a camera with another principal point.

    Splats are small, so that none that reaches into the crop is beyond the limit on the Jacobian's ray, 1.3 half widths
    of the crop.
    """
    parameters = scene(seed, sigma_px=0.3)
    parameters["scales"].clamp_(max=math.log(0.02))
    focal = settings(WIDTH, HEIGHT).tanfovx
    parameters["means"][:, 2].clamp_(min=4)
    whole = render(parameters, settings(WIDTH, HEIGHT, principal=(0.05, -0.1)))
    for start, width in ((0, cut), (cut, WIDTH - cut)):
        # With x in NDC of the whole, the part has (x W - W + 2 start + w) / w: scale by W / w, shift to its middle.
        shift = (0.05 * WIDTH + WIDTH - 2 * start - width) / width
        part = settings(WIDTH, HEIGHT, principal=(0.0, -0.1))
        projection = part.projmatrix.clone()
        projection[:, 0] *= WIDTH / width
        projection[2, 0] = shift
        part = part._replace(image_width=width, tanfovx=focal * width / WIDTH, projmatrix=projection)
        out = render(parameters, part)
        for plane in ("color", "inverse_depth", "transmittance"):
            wanted = getattr(whole, plane)[:, :, start : start + width]
            torch.testing.assert_close(getattr(out, plane), wanted, rtol=0, atol=1e-9)


@SHORT
@given(seed=SEEDS, q=QUATERNIONS, t=st.tuples(UNIT, UNIT, UNIT))
def test_moving_world_and_camera_together_changes_nothing(seed, q, t):
    """Rotate and shift everything, with degree 0, since the harmonics do not rotate along."""
    parameters = scene(seed)
    turn = rotation_matrix(torch.tensor(q))
    shift = 5 * torch.tensor(t, dtype=torch.float64)
    view = rigid((0.9, 0.1, -0.3, 0.2), (0.3, -0.2, 0.5))
    parameters["means"] = (parameters["means"] - view[:3, 3]) @ view[:3, :3]
    moved = dict(parameters)
    moved["means"] = parameters["means"] @ turn.T + shift
    moved["rotations"] = _product(q, parameters["rotations"])
    back = torch.eye(4, dtype=torch.float64)
    back[:3, :3], back[:3, 3] = turn.T, -turn.T @ shift
    cameras = [settings(WIDTH, HEIGHT, view=v, sh_degree=0) for v in (view, view @ back)]
    a, b = gradients(parameters, cameras[0]), gradients(moved, cameras[1])
    assert (a["transmittance"] < 1).any()
    assert torch.equal(a["radii"], b["radii"])
    for name in ("color", "inverse_depth", "transmittance", "d opacities", "d scales", "d sh_dc", "d means2d"):
        torch.testing.assert_close(b[name], a[name], rtol=1e-9, atol=1e-9 * a[name].abs().max().item())
    wanted = a["d means"] @ turn.T
    torch.testing.assert_close(b["d means"], wanted, rtol=1e-9, atol=1e-9 * wanted.abs().max().item())


def _product(q: tuple[float, ...], p: Tensor) -> Tensor:
    """Quaternion products q p for p (N, 4)."""
    w, x, y, z = (torch.tensor(q, dtype=torch.float64) / math.sqrt(sum(v * v for v in q))).tolist()
    left = torch.tensor([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]], dtype=torch.float64)
    return p @ left.T


@SHORT
@given(seed=SEEDS, factor=st.floats(0.3, 50), t=st.tuples(UNIT, UNIT, UNIT))
def test_the_scale_of_the_world_changes_inverse_depth_alone(seed, factor, t):
    parameters = scene(seed)
    grown = dict(parameters)
    grown["means"] = factor * parameters["means"]
    grown["scales"] = parameters["scales"] + math.log(factor)
    view = rigid((1, 0, 0, 0), tuple(0.2 * v for v in t))
    far = view.clone()
    far[:3, 3] *= factor
    # The nearest splats are at 1.8; a factor of 0.3 leaves them in front of z = 0.2.
    a = gradients(parameters, settings(WIDTH, HEIGHT, view=view, antialiasing=True))
    b = gradients(grown, settings(WIDTH, HEIGHT, view=far, antialiasing=True))
    assert torch.equal(a["radii"], b["radii"])
    for name in ("color", "transmittance"):
        torch.testing.assert_close(a[name], b[name], rtol=0, atol=1e-9)
    torch.testing.assert_close(a["inverse_depth"], factor * b["inverse_depth"], rtol=1e-9, atol=1e-9)


# Not finite values, limits of float32 and of its squares, and thresholds of the rules.
POISON = [math.nan, math.inf, -math.inf, 3.4e38, -3.4e38, 1e20, -1e20, 1e-20, 1e-38, -1e-45, 0.0, 0.2, 1.3, 16.0, 0.99]
POISON += [1 / 255, 1e-4, -50.0, 50.0, 88.0, -104.0, 1e4, 1e7]
SPOILT = st.tuples(
    st.sampled_from(["means", "opacities", "scales", "rotations", "sh_dc", "sh_rest"]),
    st.integers(0, 19),  # Gaussian
    st.sampled_from([0, 1, 2, None]),  # its value, None for all
    st.sampled_from(POISON),
)


def spoilt_scene(seed: int, places: list[tuple]) -> tuple[dict[str, Tensor], Tensor]:
    """Twenty Gaussians, float32, with poison in some places, and a flag for finite ones, (20,) bool."""
    parameters = {name: t.float() for name, t in scene(seed, 20, 4.0).items()}
    for name, row, column, value in places:
        flat = parameters[name][row].view(-1)
        flat[slice(None) if column is None else column % len(flat)] = value
    finite = torch.ones(20, dtype=torch.bool)
    for name, t in parameters.items():
        ok = ~t.isnan() if name == "opacities" else t.isfinite()  # infinite logits are opacities of 0 and 1
        finite &= ok.reshape(20, -1).all(1)
    return parameters, finite


@MANY
@given(seed=SEEDS, places=st.lists(SPOILT, min_size=1, max_size=8), antialiasing=st.booleans())
def test_poison_stays_where_it_is(seed, places, antialiasing):
    """All results are finite; Gaussians that are not finite have no effect; the order of Gaussians does not matter."""
    parameters, finite = spoilt_scene(seed, places)
    camera = settings(WIDTH, HEIGHT, torch.float32, antialiasing=antialiasing)
    got = gradients(parameters, camera)
    clean = gradients(pick(parameters, finite), camera)
    depths = parameters["means"][:, 2]
    seen = depths[finite]
    order = torch.randperm(20, generator=torch.Generator().manual_seed(seed))
    permuted = gradients(pick(parameters, order), camera) if len(seen.unique()) == len(seen) else None
    for name, t in got.items():
        assert t.isfinite().all(), name
        per_splat = name == "radii" or name.startswith("d ")
        assert torch.equal(t[finite] if per_splat else t, clean[name]), name
        assert not name.startswith("d ") or not t[~finite].any(), name
        assert permuted is None or torch.equal(permuted[name], t[order] if per_splat else t), name


@MANY
@given(seed=SEEDS, places=st.lists(SPOILT, max_size=8), antialiasing=st.booleans())
def test_weights_of_any_scene_sum_to_at_most_one(seed, places, antialiasing):
    parameters, _ = spoilt_scene(seed, places)
    colors = {"colors": torch.ones(20, 3)}
    shape = {name: t for name, t in parameters.items() if not name.startswith("sh")}
    camera = settings(WIDTH, HEIGHT, torch.float32, bg=torch.zeros(3), antialiasing=antialiasing)
    out = render(shape | colors, camera)
    assert out.color.min() >= 0
    # At most 20 rounded products and sums.
    torch.testing.assert_close(out.color + out.transmittance, torch.ones(3, HEIGHT, WIDTH), rtol=0, atol=3e-6)
