"""Spherical harmonics against SciPy's."""

import numpy as np
import pytest
import torch
from diff_gaussian_rasterization.harmonics import sh_basis as gsplats_basis
from diff_gaussian_rasterization.reference.colour import sh_basis as oracles_basis
from scipy.special import sph_harm_y

from utils.sh_utils import C0, C1, C2, C3, C4, RGB2SH, SH2RGB, eval_sh, sh_basis


def _directions(count: int) -> torch.Tensor:
    d = torch.randn(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return torch.nn.functional.normalize(d, dim=-1)


def _real(l: int, m: int, theta: np.ndarray, phi: np.ndarray) -> np.ndarray:  # noqa: E741
    if m == 0:
        return sph_harm_y(l, 0, theta, phi).real
    # SciPy's complex harmonics carry the Condon-Shortley sign, as the basis does.
    value = np.sqrt(2) * sph_harm_y(l, abs(m), theta, phi)
    return value.real if m > 0 else value.imag


def test_bases_are_scipys():
    """Compare the basis of the reference's helpers, of gsplat's function, and of the oracle, for rays of any length."""
    d = _directions(40)
    x, y, z = d.numpy().T
    theta, phi = np.arccos(z), np.arctan2(y, x)
    wanted = np.stack([_real(l, m, theta, phi) for l in range(7) for m in range(-l, l + 1)], axis=-1)  # noqa: E741
    np.testing.assert_allclose(gsplats_basis(6, d).numpy(), wanted, atol=1e-12)
    # The arccos near the poles loses some digits.
    np.testing.assert_allclose(sh_basis(4, d).numpy(), wanted[:, :25], atol=1e-13)
    np.testing.assert_allclose(oracles_basis(3.7 * d).numpy(), wanted[:, :16], rtol=0, atol=1e-13)


def test_factors_by_degree():
    """Those that other code multiplies with its own polynomials; the signs are those of the rasterizer."""
    np.testing.assert_allclose([C0, C1], np.sqrt(np.array([1, 3]) / (4 * np.pi)), rtol=1e-15)
    assert [len(factors) for factors in (C2, C3, C4)] == [5, 7, 9]
    x, y, z = d = _directions(1)[0]
    basis = sh_basis(4, d)
    assert basis[1] == -C1 * y and basis[4] == C2[0] * x * y and basis[10] == C3[1] * x * y * z
    assert basis[16] == C4[0] * x * y * (x * x - y * y) and basis[8] == C2[4] * (x * x - y * y)


@pytest.mark.parametrize("degree", range(5))
def test_eval_sh_reads_only_its_bands(degree):
    g = torch.Generator().manual_seed(1)
    sh = torch.randn(10, 3, 25, dtype=torch.float64, generator=g)
    d = _directions(10)
    count = (degree + 1) ** 2
    wanted = torch.einsum("nck,nk->nc", sh[..., :count], sh_basis(4, d)[:, :count])
    sh[..., count:] = torch.nan
    torch.testing.assert_close(eval_sh(degree, sh, d), wanted)


def test_degree_0_colours():
    rgb = torch.tensor([0.0, 0.25, 1.0])
    torch.testing.assert_close(SH2RGB(RGB2SH(rgb)), rgb)
    torch.testing.assert_close(eval_sh(0, RGB2SH(rgb)[:, None], torch.tensor([0.0, 0.0, 1.0])) + 0.5, rgb)


def test_other_degrees_are_refused():
    with pytest.raises(ValueError, match="0 to 4"):
        sh_basis(5, _directions(1))
