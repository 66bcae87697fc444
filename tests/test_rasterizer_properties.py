"""Properties that hold for every scene, tried on drawn ones.

GS_FUZZ=2000 in the environment draws that many scenes for each property.
"""

import math
import os

import torch
from hypothesis import HealthCheck, given
from hypothesis import settings as budget
from hypothesis import strategies as st
from rasterizer_tools import gradients, pick, render
from torch import Tensor

from benchmarks.workloads.splat_scenes import frustum, settings

SEEDS = st.integers(0, 2**31 - 1)
FUZZ = int(os.environ.get("GS_FUZZ", "0"))
MANY = budget(max_examples=FUZZ or 150, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
WIDTH, HEIGHT = 64, 48

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
    parameters = {name: t.float() for name, t in frustum(20, WIDTH, HEIGHT, 4.0, seed).parameters.items()}
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
