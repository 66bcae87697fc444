"""gsplat's `rasterization` on our rasterizer, beside plain compositing in float64 by the published rules.

The judge outside of the repository is gsplat 1.5.3's own PyTorch code: its projection and harmonics agree to 1e-13.
"""

import math
import sys
from types import ModuleType

import numpy as np
import pytest
import scipy.special
import torch
from diff_gaussian_rasterization.gsplat import programs, rasterization
from diff_gaussian_rasterization.gsplat.inputs import MODES
from diff_gaussian_rasterization.harmonics import sh_basis
from rasterizer_tools import CPU_AND_GPU
from torch import Tensor

from utils.general_utils import build_rotation
from utils.sh_utils import eval_sh

WIDTH, HEIGHT, CAMERAS = 40, 31, 2
DOUBLE = torch.float64


class Inputs:
    """Random Gaussians before two cameras; float64, gradients wanted."""

    def __init__(self, seed: int, channels: int = 3, degree: int | None = None, count: int = 60) -> None:
        generator = torch.Generator().manual_seed(seed)

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator, dtype=DOUBLE)

        self.means, self.quats = 1.2 * normal(count, 3), normal(count, 4)
        self.scales = (0.7 * normal(count, 3) - 1.8).exp()
        opaque = 1.1 * torch.rand(count, generator=generator, dtype=DOUBLE) + 0.005
        self.opacities = opaque.clamp_max(1.0)
        self.colors = normal(count, channels) if degree is None else 0.3 * normal(count, 16, 3)
        self.degree, self.backgrounds = degree, normal(CAMERAS, 3 if degree is not None else channels)
        self.views = torch.eye(4, dtype=DOUBLE).repeat(CAMERAS, 1, 1)
        self.views[:, :3, :3] = build_rotation(normal(CAMERAS, 4) * 0.1 + torch.tensor([1.0, 0, 0, 0]))
        self.views[:, :3, 3] = 0.3 * normal(CAMERAS, 3) + torch.tensor([0, 0, 3.0])
        K = [[35.0, 0, 19], [0, 38, 15], [0, 0, 1]]
        self.Ks = torch.tensor(K, dtype=DOUBLE).repeat(CAMERAS, 1, 1)
        self.wanted = {name: getattr(self, name).requires_grad_() for name in NAMES}

    def draw(self, **options) -> tuple[Tensor, Tensor, dict]:
        given = {name: getattr(self, name) for name in ("means", "quats", "scales", "opacities", "colors", "Ks")}
        given |= {"viewmats": self.views, "sh_degree": self.degree, "backgrounds": self.backgrounds}
        return rasterization(**given | {"width": WIDTH, "height": HEIGHT} | options)

    def gradients(self, image: Tensor, alpha: Tensor) -> dict[str, Tensor]:
        generator = torch.Generator().manual_seed(7)
        loss = sum((torch.randn(t.shape, generator=generator, dtype=DOUBLE) * t).sum() for t in (image, alpha))
        found = torch.autograd.grad(loss, list(self.wanted.values()), allow_unused=True)
        return {
            n: torch.zeros_like(t) if g is None else g for (n, t), g in zip(self.wanted.items(), found, strict=True)
        }


NAMES = ("means", "quats", "scales", "opacities", "colors", "views")


def places(model: str, at: Tensor) -> Tensor:
    """Project points of a view, (N, 2), by a camera of focal length 1; a fisheye is equidistant."""
    away = at[:, :2].norm(dim=1, keepdim=True)
    if model == "fisheye":
        return at[:, :2] * torch.atan2(away, at[:, 2:]) / away
    return at[:, :2] if model == "ortho" else at[:, :2] / at[:, 2:]


def described(given: Inputs, antialiased: bool, eps2d: float, model: str = "pinhole") -> dict[str, Tensor]:
    """Means, depths, conics and opacities on the images (Zwicker et al. 2001; Kerbl et al. 2023)."""
    found = {"means2d": [], "depths": [], "conics": [], "opacities": []}
    for view, K in zip(given.views, given.Ks, strict=True):
        at = given.means @ view[:3, :3].T + view[:3, 3]
        R = view[:3, :3] @ build_rotation(given.quats) * given.scales[:, None]
        on_image = places(model, at)
        limit = [((size - K[i, 2]) / K[i, i] + 0.15 * size / K[i, i], K[i, 2] / K[i, i] + 0.15 * size / K[i, i])
                 for i, size in enumerate((WIDTH, HEIGHT))]  # fmt: skip
        depth = at[:, 2]
        t = [(at[:, i] / depth).clamp(-low, high) for i, (high, low) in enumerate(limit)]
        zero = torch.zeros_like(depth)
        J = torch.stack([K[0, 0] / depth, zero, -K[0, 0] * t[0] / depth,
                         zero, K[1, 1] / depth, -K[1, 1] * t[1] / depth], 1).view(-1, 2, 3)  # fmt: skip
        if model != "pinhole":  # whose rays alone are clamped
            rows = [torch.autograd.grad(on_image[:, i].sum(), at, create_graph=True)[0] for i in (0, 1)]
            J = K.diagonal()[:2, None] * torch.stack(rows, 1)
        flat = J @ R @ R.mT @ J.mT
        wide = flat + eps2d * torch.eye(2, dtype=DOUBLE)
        inverse = wide.inverse()
        found["means2d"].append(on_image * K.diagonal()[:2] + K[:2, 2])
        found["depths"].append(depth)
        found["conics"].append(torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], 1))
        factor = (flat.det() / wide.det()).clamp_min(0).sqrt() if antialiased else 1
        found["opacities"].append(given.opacities * factor)
    return {name: torch.stack(values) for name, values in found.items()}


def composited(given: Inputs, mode: str, notes: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    """Images and alphas of what is described, pixel by pixel."""
    y, x = torch.meshgrid(*(torch.arange(n, dtype=DOUBLE) + 0.5 for n in (HEIGHT, WIDTH)), indexing="ij")
    images, alphas = [], []
    for n in range(len(given.views)):
        means, depth, conics, opacity = (notes[name][n] for name in ("means2d", "depths", "conics", "opacities"))
        dx, dy = (means[:, i] - p.reshape(-1, 1) for i, p in enumerate((x, y)))
        power = 0.5 * (conics[:, 0] * dx**2 + conics[:, 2] * dy**2) + conics[:, 1] * dx * dy
        alpha = (opacity * (-power).exp()).clamp_max(0.999)
        alpha = torch.where((alpha >= 1 / 255) & (depth > 0.01), alpha, 0)
        order = depth.detach().argsort()
        alpha = alpha[:, order]
        alpha = alpha * ((1 - alpha).cumprod(1) >= 1e-4)
        left = torch.cat([torch.ones(len(alpha), 1, dtype=DOUBLE), (1 - alpha).cumprod(1)], 1)
        color = given.colors
        if given.degree is not None:
            away = torch.nn.functional.normalize(given.means - torch.linalg.inv(given.views[n])[:3, 3], dim=1)
            color = (eval_sh(given.degree, color.mT, away) + 0.5).clamp_min(0)
        parts = [color] * mode.startswith("RGB") + [depth[:, None]] * mode.endswith("D")
        behind = torch.nn.functional.pad(given.backgrounds[n], (0, 1))[-sum(part.shape[1] for part in parts) :]
        behind = given.backgrounds[n] if mode == "RGB" else behind
        image = (alpha * left[:, :-1]) @ torch.cat(parts, 1)[order] + left[:, -1:] * behind
        covered = 1 - left[:, -1:]
        if mode.endswith("ED"):
            image = torch.cat([image[:, :-1], image[:, -1:] / covered.clamp_min(1e-10)], 1)
        images.append(image.view(HEIGHT, WIDTH, -1))
        alphas.append(covered.view(HEIGHT, WIDTH, 1))
    return torch.stack(images), torch.stack(alphas)


@pytest.mark.parametrize("form", [(3, None), (7, None), (37, None), (3, 2)], ids=str)
@pytest.mark.parametrize("mode", MODES)
def test_images_and_gradients_are_those_of_plain_compositing(mode, form):
    for seed, (eps2d, antialiased) in enumerate([(0.3, form[0] == 7), (0.05, form[0] != 7)]):
        given = Inputs(seed, *form)
        expected = composited(given, mode, described(given, antialiased, eps2d))
        options = {"rasterize_mode": "antialiased" if antialiased else "classic", "eps2d": eps2d}
        found = given.draw(render_mode=mode, **options)[:2]
        pairs = dict(zip(("image", "alpha"), zip(found, expected, strict=True), strict=True))
        both = [given.gradients(*images) for images in (found, expected)]
        for name, (got, wanted) in (pairs | {n: (both[0][n], both[1][n]) for n in NAMES}).items():
            if name == "views":
                got, wanted = got[:, :3], wanted[:, :3]  # the last row of a pose is no input
            scale = wanted.abs().max().clamp_min(1e-9)
            assert (got - wanted).abs().max() < 1e-9 * scale, (name, seed)


@pytest.mark.parametrize("degree", [None, 2])
@pytest.mark.parametrize("model", ["pinhole", "fisheye", "ortho"])
def test_all_cameras_and_tiny_gaussians_are_those_of_plain_compositing(model, degree):
    """Antialiased, without a floor; SH are seen from the camera's centre. A fourth channel changes no other."""
    given = Inputs(3, degree=degree, count=300)
    with torch.no_grad():
        given.scales[::2] *= 0.02
        given.Ks[:, :2, :2] /= 4 if model == "ortho" else 1
    options = {"camera_model": model, "rasterize_mode": "antialiased"}
    expected = composited(given, "RGB+D", described(given, True, 0.3, model))
    found = given.draw(render_mode="RGB+D", **options)[:2]
    both = [given.gradients(*images) for images in (found, expected)]
    pairs = dict(zip(("image", "alpha"), zip(found, expected, strict=True), strict=True))
    for name, (got, wanted) in (pairs | {n: (both[0][n], both[1][n]) for n in NAMES}).items():
        if name == "views":
            got, wanted = got[:, :3], wanted[:, :3]
        assert (got - wanted).abs().max() < 1e-9 * wanted.abs().max(), name
    given.colors = torch.cat([given.colors, given.colors[..., :1]], -1)
    given.backgrounds = torch.nn.functional.pad(given.backgrounds, (0, 1))
    assert torch.allclose(given.draw(**options)[0][..., :3], found[0][..., :3], atol=1e-9)


@pytest.mark.parametrize(("packed", "cameras"), [(False, 1), (True, 1), (False, 2), (True, 2)])
@pytest.mark.parametrize("hooked", ["means2d", "conics", "opacities", "depths", None])
def test_notes_are_part_of_the_graph(hooked, packed, cameras):
    """A loss of notes and image; and a hook that changes the gradient of one of them, in place."""
    found = []
    for ours in (False, True):
        given = Inputs(8)
        for name in ("views", "Ks", "backgrounds"):
            setattr(given, name, getattr(given, name)[:cameras])
        if ours:
            image, _, notes = given.draw(packed=packed, render_mode="RGB+D", rasterize_mode="antialiased")
            rows = (notes["camera_ids"], notes["gaussian_ids"]) if packed else (notes["radii"] > 0).all(-1)
        else:
            notes = described(given, True, 0.3)
            image = composited(given, "RGB+D", notes)[0]
            rows = (given.draw(packed=False)[2]["radii"] > 0).all(-1)
        if hooked:
            notes[hooked].register_hook(
                (lambda gradient: gradient.mul_(3.0)) if ours else lambda gradient: 3.0 * gradient
            )
        loss = image.square().mean()
        for name in ("means2d", "conics", "opacities", "depths") if not hooked else ():
            values = notes[name] if ours and packed else notes[name][rows]
            loss = loss + (values * torch.arange(1, values.numel() + 1, dtype=DOUBLE).view_as(values)).sin().sum()
        found.append(torch.autograd.grad(loss, [given.wanted[name] for name in NAMES if name != "views"]))
    for got, wanted in zip(*found[::-1], strict=True):
        assert (got - wanted).abs().max() < 1e-9 * wanted.abs().max()


@CPU_AND_GPU
@pytest.mark.parametrize("packed", [False, True])
def test_float32_agrees_with_float64(packed, device):
    """Image, notes, lists and gradients, of SH and of many channels, by kernels of each device."""
    for seed, (channels, degree) in enumerate([(3, 3), (3, None), (2, None), (37, None)]):
        found = []
        for like in ({"dtype": DOUBLE}, {"dtype": torch.float32, "device": device}):
            given = Inputs(seed, channels, degree)
            for name in (*NAMES, "Ks", "backgrounds"):
                setattr(given, name, getattr(given, name).detach().to(**like).requires_grad_(name in NAMES))
            image, alpha, meta = given.draw(packed=packed, render_mode="RGB+D", absgrad=channels < 32)
            meta["means2d"].retain_grad()
            weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(1), dtype=DOUBLE)
            (image * weights.to(image)).sum().backward()
            notes = [
                meta[name] for name in ("means2d", "depths", "conics", "opacities", "flatten_ids", "isect_offsets")
            ]
            grads = [getattr(given, name).grad for name in NAMES]
            found.append([image, alpha, *notes, meta["means2d"].grad, *grads])
            if channels < 32:
                found[-1].append(meta["means2d"].absgrad)
        for wanted, got in zip(*found, strict=True):
            assert wanted.shape == got.shape
            assert (got.cpu().double() - wanted).abs().max() <= 1e-4 * wanted.abs().max(), (channels, degree)


def zero_unnoticed(gradient: Tensor) -> None:
    """In place without a new version, as by numpy."""
    gradient.data.zero_()


@CPU_AND_GPU
@pytest.mark.parametrize(("packed", "cameras"), [(False, 1), (True, 1), (False, 2), (True, 2)])
@pytest.mark.parametrize("change", [lambda gradient: 0 * gradient, Tensor.zero_, zero_unnoticed])
def test_gradients_that_hooks_zero_leave_nothing(change, packed, cameras, device):
    """Not even a rounding error, of which Adam would make a whole step; other gradients stay."""
    found = []
    for hooked in ((), ("means2d", "conics", "opacities")):
        given = Inputs(8)
        for name in (*NAMES, "Ks", "backgrounds"):
            value = getattr(given, name)[:cameras] if name in ("views", "Ks", "backgrounds") else getattr(given, name)
            setattr(given, name, value.detach().float().to(device).requires_grad_(name in NAMES))
        image, _, notes = given.draw(packed=packed)
        for name in hooked:
            notes[name].register_hook(change)
        del notes
        image.square().sum().backward()
        found.append({name: getattr(given, name).grad for name in NAMES})
    assert torch.equal(*(one.pop("colors") for one in found))
    assert all(t.any() for t in found[0].values()) and not any(t.any() for t in found[1].values())


def test_a_hook_of_one_pass_changes_no_other():
    """Gradients of means2d alone, then of all without the image, then of all."""
    given = Inputs(8)
    image, _, notes = given.draw(packed=False)
    (first,) = torch.autograd.grad(image.sum(), notes["means2d"], retain_graph=True)
    (own,) = torch.autograd.grad(notes["means2d"].sum(), given.means, retain_graph=True)
    (both,) = torch.autograd.grad(image.sum() + notes["means2d"].sum(), given.means, retain_graph=True)
    (shown,) = torch.autograd.grad(image.sum(), given.means)
    assert first.any() and own.any() and torch.allclose(own + shown, both, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("packed", [False, True])
def test_lists_of_tiles_are_made_when_they_are_read(packed):
    given = Inputs(9)
    meta = given.draw(packed=packed)[2]
    assert "isect_ids" not in meta
    ids, numbers, begins = (meta[name] for name in ("isect_ids", "flatten_ids", "isect_offsets"))
    assert begins.shape == (CAMERAS, 2, 3) and len(ids) == len(numbers) == meta["tiles_per_gauss"].sum()
    assert torch.equal(ids, ids.sort()[0]) and torch.equal(numbers.bincount(), meta["tiles_per_gauss"].flatten())
    depths = meta["depths"].flatten()[numbers].float()
    assert torch.equal(ids & 0xFFFFFFFF, depths.view(torch.int32).long())
    tiles = ids >> 32
    assert torch.equal(tiles >> 3, torch.repeat_interleave(torch.tensor([0, 1]), (tiles >> 3).bincount()))
    assert torch.equal(
        begins.flatten(), torch.searchsorted(tiles, torch.tensor([0, 1, 2, 3, 4, 5, 8, 9, 10, 11, 12, 13]))
    )
    assert "isect_ids" in meta
    with pytest.raises(KeyError, match="nothing"):
        meta["nothing"]
    with pytest.raises(ValueError, match="a tile_size of 16 alone, got 8"):
        given.draw(tile_size=8)[2]["isect_ids"]


@pytest.mark.parametrize("degree", [2, 4])
def test_signals_come_beside_the_image(degree):
    """Signals as SH and as values, each beside colours by themselves; SH of degree 4, shared by batches."""
    given = Inputs(10, degree=2)
    given.colors = 0.3 * torch.randn(60, (degree + 1) ** 2, 3, dtype=DOUBLE)
    signals = torch.randn(60, 5, dtype=DOUBLE).requires_grad_()
    image, _, meta = given.draw(render_mode="RGB+D", sh_degree=degree, extra_signals=signals)
    assert torch.equal(image, given.draw(render_mode="RGB+D", sh_degree=degree)[0])
    given.backgrounds = None
    alone = given.draw(colors=signals, sh_degree=None)[0]
    assert torch.allclose(meta["render_extra_signals"], alone, atol=1e-12)
    meta["render_extra_signals"].sum().backward()
    assert signals.grad.any()
    away = torch.nn.functional.normalize(given.means - torch.linalg.inv(given.views[0])[:3, 3], dim=1)
    values = torch.einsum("nk,nkd->nd", sh_basis(degree, away), given.colors) + 0.5
    of_bands = given.draw(colors=values.clamp_min(0), sh_degree=None)[0]
    assert torch.allclose(given.draw(sh_degree=degree)[0][0], of_bands[0], atol=1e-12)
    raw = given.draw(extra_signals=given.colors, extra_signals_sh_degree=degree, sh_degree=degree)[2]
    assert torch.allclose(raw["render_extra_signals"][0], given.draw(colors=values, sh_degree=None)[0][0], atol=1e-12)
    for name in ("means", "quats", "scales", "opacities", "views", "Ks"):
        setattr(given, name, torch.stack([getattr(given, name)] * 2))
    both = given.draw(sh_degree=degree)[0]
    assert torch.equal(both[0], both[1]) and torch.allclose(both[0, 0], of_bands[0], atol=1e-12)


def test_harmonics_of_any_degree_are_those_of_scipy():
    away = torch.nn.functional.normalize(torch.randn(20, 3, dtype=DOUBLE), dim=1)
    x, y, z = away.T.numpy()
    found, at = sh_basis(6, away), 0
    for degree in range(7):
        for order in range(-degree, degree + 1):
            value = scipy.special.sph_harm_y(degree, abs(order), np.arccos(z), np.arctan2(y, x))
            wanted = value.real if order == 0 else math.sqrt(2) * (value.real if order > 0 else value.imag)
            assert np.allclose(found[:, at], wanted, atol=1e-12), (degree, order)
            at += 1


def test_depths_may_be_distances_and_images_depths_alone():
    given = Inputs(11)
    alone, _, meta = given.draw(colors=None, render_mode="D", global_z_order=False, packed=False)
    at = torch.stack([given.means @ view[:3, :3].T + view[:3, 3] for view in given.views])
    shown = (meta["radii"] > 0).all(-1)
    assert torch.allclose(meta["depths"][shown], at.norm(dim=-1)[shown])
    given.colors = given.colors.detach()
    by_z = given.draw(colors=at[0].norm(dim=-1)[:, None].detach(), backgrounds=None)[0][0]
    assert (alone[0] - by_z).abs().median() < 1e-3 * by_z.abs().max() and not torch.equal(alone[0], by_z)
    loss = alone.mean()
    loss.backward()
    assert given.means.grad.any()


def test_meta_has_what_strategies_read():
    given = Inputs(1)
    _, _, meta = given.draw(packed=False)
    at = torch.stack([given.means @ view[:3, :3].T + view[:3, 3] for view in given.views])
    projected = at @ given.Ks.mT
    shown = (meta["radii"] > 0).all(-1)
    assert torch.allclose(meta["depths"], at[..., 2] * shown)
    assert meta["radii"].dtype == torch.int32 and 20 < shown.sum() < shown.numel()
    assert torch.allclose(meta["means2d"][shown], (projected[..., :2] / projected[..., 2:])[shown])
    wide = torch.linalg.inv(meta["conics"][shown][:, [0, 1, 1, 2]].view(-1, 2, 2))
    extent = (2 * (255 * meta["opacities"][shown]).log()).sqrt().clamp_max(3.33)[:, None]
    assert torch.equal(meta["radii"][shown].double(), (extent * wide.diagonal(dim1=-2, dim2=-1).sqrt()).ceil())
    packed = given.draw()[2]
    image, row = shown.nonzero(as_tuple=True)
    assert torch.equal(packed["camera_ids"], image) and torch.equal(packed["gaussian_ids"], row)
    for name in ("radii", "means2d", "depths", "conics", "opacities"):
        assert torch.equal(packed[name], meta[name][shown]), name
    assert {packed[name] for name in ("width", "height", "n_cameras")} == {WIDTH, HEIGHT, CAMERAS}


@pytest.mark.parametrize("packed", [False, True])
def test_means2d_gets_its_gradient_in_pixels(packed):
    """Beside that of the means: they move on the image by focal length over depth."""
    given = Inputs(2)
    image, _, meta = given.draw(packed=packed, absgrad=True)
    meta["means2d"].retain_grad()
    image.square().sum().backward()
    gradient, absolute = meta["means2d"].grad, meta["means2d"].absgrad
    assert gradient.shape == absolute.shape == meta["means2d"].shape and gradient.any()
    by_ndc = gradient * torch.tensor([WIDTH, HEIGHT]) / 2
    assert (absolute[..., 0] * WIDTH / 2 >= by_ndc.norm(dim=-1) * (1 - 1e-9)).all()
    moved = given.views.detach().clone().requires_grad_()
    given.wanted["views"] = given.views = moved
    image, _, meta = given.draw(packed=packed)
    meta["means2d"].retain_grad()
    image.square().sum().backward()
    # A camera that is moved along x moves all means on the image, and nothing else to first order but their shapes.
    assert torch.allclose(meta["means2d"].grad, gradient)


@CPU_AND_GPU
def test_radii_tell_whether_a_box_around_the_mean_meets_the_image(device):
    """The strategies of gsplat count views by radii. It does not matter if a Gaussian reaches the centre of a pixel."""
    given = Inputs(4, count=4000)
    with torch.no_grad():
        given.means *= 2
        given.scales *= 0.1
        given.opacities *= torch.linspace(0, 0.05, 4000, dtype=DOUBLE)
    notes = described(given, False, 0.3)
    variance = torch.linalg.inv(notes["conics"][..., [0, 1, 1, 2]].unflatten(-1, (2, 2))).diagonal(dim1=-2, dim2=-1)
    reach = (2 * (255 * notes["opacities"]).log()).clamp_min(0).sqrt().clamp_max(3.33)[..., None]
    radii = (reach * variance.sqrt()).ceil()
    size = torch.tensor([WIDTH, HEIGHT])
    beyond = torch.minimum(notes["means2d"] + radii, size - notes["means2d"] + radii).amin(-1)
    shown = (notes["depths"] > 0.01) & (reach[..., 0] > 0) & (beyond > 0)
    for name in (*NAMES, "Ks", "backgrounds"):
        value = getattr(given, name).detach().to(device, torch.float32 if device == "cuda" else DOUBLE)
        setattr(given, name, value.requires_grad_(name == "opacities"))
    image, _, meta = given.draw(packed=False)
    found, tiles = meta["radii"].cpu(), meta["tiles_per_gauss"].cpu() > 0
    sure = (beyond.abs() > 1e-3) & ((notes["depths"] - 0.01).abs() > 1e-3)
    assert torch.equal((found > 0).all(-1)[sure], shown[sure]) and sure.double().mean() > 0.99
    assert (found - radii)[shown & sure].abs().max() <= (device == "cuda") and not (tiles & ~shown)[sure].any()
    assert (shown & ~tiles).sum() > 0.01 * shown.sum()
    packed = given.draw(packed=True)[2]
    assert torch.equal(packed["gaussian_ids"].cpu(), (found > 0).all(-1).nonzero()[:, 1])
    image.sum().backward()
    assert not given.opacities.grad[~tiles.any(0)].any() and given.opacities.grad.any()


@pytest.mark.parametrize("opacity", [1 / 255, 100.0])
def test_what_has_a_tile_is_shown(opacity):
    """Also where gsplat's box ends before it: of an opacity that is just visible, and of more than 1."""
    gradients = []
    for weight in (0.0, 1.0):
        given = Inputs(4, count=500)
        with torch.no_grad():
            given.opacities.fill_(opacity)
        image, _, meta = given.draw()
        listed = meta["flatten_ids"]
        assert len(listed) and listed.min() >= 0 and listed.max() < len(meta["gaussian_ids"])
        assert (meta["opacities"] > 0).all() and (meta["tiles_per_gauss"] > 0).any()
        (image.sum() + weight * meta["depths"].sum()).backward()
        gradients.append(given.opacities.grad)
    assert torch.equal(*gradients) and (gradients[0].any() or opacity < 1)


@CPU_AND_GPU
def test_a_colour_that_is_not_finite_spoils_no_other_gradient(device):
    """Two Gaussians: one in the image, and one without a tile, whose colour nothing reads on a GPU."""
    given = Inputs(5, degree=2, count=4000)
    with torch.no_grad():
        given.scales *= 0.1
        given.opacities *= torch.linspace(0, 0.05, 4000, dtype=DOUBLE)
        given.opacities[0] = 1.0
    for name in (*NAMES, "Ks", "backgrounds"):
        setattr(given, name, getattr(given, name).detach().float().to(device).requires_grad_(name in NAMES))
    meta = given.draw(packed=False)[2]
    bad = ((meta["radii"] > 0).all(-1) & (meta["tiles_per_gauss"] == 0)).any(0) & (meta["tiles_per_gauss"] == 0).all(0)
    assert bad.any() and meta["radii"][:, 0].any()
    bad[0] = True
    with torch.no_grad():
        given.colors[bad] = math.nan
    image, _, meta = given.draw(packed=False)
    (image.sum() + meta["means2d"].sum() + meta["depths"].sum()).backward()
    assert not meta["radii"][:, 0].any()
    for name in ("means", "scales", "views"):
        gradient = getattr(given, name).grad
        assert gradient.isfinite().all() and gradient.any(), name


def test_sparse_gradients_have_the_rows_that_are_shown():
    grads = []
    for sparse in (False, True):
        given = Inputs(2, count=200)
        image, _, meta = given.draw(sparse_grad=sparse)
        image.square().sum().backward()
        grads.append([given.wanted[name].grad for name in ("means", "quats", "scales")])
    for dense, sparse in zip(*grads, strict=True):
        assert sparse.is_sparse and torch.equal(sparse.to_dense(), dense)
        assert torch.equal(sparse.coalesce().indices()[0], meta["gaussian_ids"].unique()) and sparse._nnz() < 200


def test_what_is_not_read_changes_nothing():
    """The other numbers of an intrinsic matrix, bands above the degree 3, sizes as tensors, and autocast."""
    given = Inputs(5, degree=3)
    image = given.draw()[0]
    given.Ks = given.Ks.clone()
    given.Ks[:, 0, 1], given.Ks[:, 2] = 7.0, torch.tensor([0.1, 0.2, 3.0])
    given.colors = torch.cat([given.colors, torch.ones(60, 9, 3, dtype=DOUBLE)], 1)
    again, _, meta = given.draw(width=torch.tensor(float(WIDTH)), height=torch.tensor(HEIGHT))
    assert torch.equal(again, image) and type(meta["width"]) is int
    given.backgrounds = given.backgrounds[:1].expand(CAMERAS, 3)
    assert torch.equal(given.draw(backgrounds=given.backgrounds[0])[0], given.draw()[0])
    for name in (*NAMES, "backgrounds"):
        setattr(given, name, getattr(given, name).detach().float())
    given.Ks = given.Ks.float()
    image = given.draw(render_mode="RGB+D")[0]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(image, given.draw(render_mode="RGB+D")[0])


def test_leading_batches_and_colours_of_each_camera():
    given, other = Inputs(3), Inputs(4)
    colors = torch.stack([given.colors, given.colors.flip(0)])
    both = [torch.stack([getattr(one, name).detach() for one in (given, other)]) for name in NAMES[:4]]
    rest = torch.stack([colors.detach()] * 2), torch.stack([given.views, other.views]).detach()
    image, alpha, meta = rasterization(*both, *rest, given.Ks.expand(2, -1, -1, -1), WIDTH, HEIGHT, packed=False)
    assert image.shape == (2, CAMERAS, HEIGHT, WIDTH, 3) and alpha.shape == (2, CAMERAS, HEIGHT, WIDTH, 1)
    assert meta["means2d"].shape == (2, CAMERAS, 60, 2) and meta["n_batches"] == 2
    given.backgrounds = None
    for n in range(CAMERAS):
        given.colors = colors[n]
        assert torch.equal(image[0, n], given.draw()[0][n])


def test_planes_and_radii_that_are_left_out():
    given = Inputs(5)
    depth = given.draw(packed=False)[2]["depths"]
    near, far = depth.quantile(0.3).item(), depth.quantile(0.7).item()
    meta = given.draw(near_plane=near, far_plane=far, packed=False)[2]
    shown = (meta["radii"] > 0).all(-1)
    assert shown.any() and ((depth > near) & (depth < far))[shown].all()
    single = [t.float() for t in (given.means, given.quats, given.scales, given.opacities, given.colors)]
    cameras = given.views.float(), given.Ks.float(), WIDTH, HEIGHT
    nearest = [rasterization(*single, *cameras, near_plane=plane)[0] for plane in (0.0, 1e-40)]
    assert nearest[0].any() and torch.equal(*nearest)
    image, _, clipped = given.draw(radius_clip=6.0, packed=False)
    radii = given.draw(packed=False)[2]["radii"]
    small = (radii <= 6).all(-1)
    assert small.any() and not clipped["radii"][small].any() and torch.equal(clipped["radii"][~small], radii[~small])
    assert not torch.equal(image, given.draw()[0])


@pytest.mark.parametrize("packed", [False, True])
def test_no_gaussians_show_the_background(packed):
    given = Inputs(0, count=0)
    image, alpha, meta = given.draw(packed=packed, absgrad=True)
    assert torch.equal(image, given.backgrounds[:, None, None].expand_as(image)) and not alpha.any()
    meta["means2d"].retain_grad()
    image.sum().backward()
    assert given.means.grad.shape == (0, 3) and meta["means2d"].grad.shape[-2:] == (0, 2)


def test_only_what_a_gradient_is_wanted_of_gets_one():
    given = Inputs(0)
    for name, tensor in given.wanted.items():
        setattr(given, name, tensor.detach())
    image, alpha, meta = given.draw()
    assert not (image.requires_grad or alpha.requires_grad or meta["means2d"].requires_grad)
    given.backgrounds.requires_grad_()
    assert given.draw()[0].requires_grad


def test_covariances_in_place_of_scales():
    given = Inputs(6)
    M = build_rotation(given.quats) * given.scales[:, None]
    image, alpha, _ = rasterization(
        given.means, None, None, given.opacities, given.colors, given.views, given.Ks, WIDTH, HEIGHT, covars=M @ M.mT
    )
    given.backgrounds = None
    assert torch.allclose(image, given.draw()[0], atol=1e-9) and math.isfinite(alpha.sum())


def test_a_fisheye_shows_where_its_lens_does():
    """One small Gaussian, 60 degrees off the axis: the angle times the focal length."""
    angle = math.radians(60)
    mean = torch.tensor([[math.sin(angle), 0, math.cos(angle)]])
    K = torch.tensor([[[30.0, 0, 50], [0, 30, 40], [0, 0, 1]]])
    one = torch.ones(1, 3)
    image, _, meta = rasterization(
        mean, torch.tensor([[1.0, 0, 0, 0]]), 0.01 * one, torch.ones(1) * 0.9, one, torch.eye(4)[None], K, 100, 80,
        camera_model="fisheye",
    )  # fmt: skip
    assert torch.allclose(meta["means2d"], torch.tensor([[50 + 30 * angle, 40.0]]), atol=1e-4)
    assert image[0, 40, int(50 + 30 * angle)].min() > 0.3


@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
def test_an_orthographic_image_does_not_depend_on_depth(dtype):
    like = {"dtype": dtype}
    mean = torch.tensor([[0.5, -0.25, 2.0]], requires_grad=True, **like)
    K = torch.tensor([[[20.0, 0, 20.5], [0, 20, 15.5], [0, 0, 1]]], **like)
    view, images = torch.eye(4, **like), []
    view[:3, :3] = build_rotation(torch.tensor([[0.9, 0.3, -0.2, 0.1]], **like))[0]
    for away in (0, 3, 50):
        far = (mean + torch.tensor([0, 0, away], **like)) @ view[:3, :3]
        image, _, meta = rasterization(
            far, torch.tensor([[1.0, 0, 0, 0]], **like), torch.full((1, 3), 0.1, **like), torch.full((1,), 0.9, **like),
            torch.ones(1, 3, **like), view[None], K, WIDTH, HEIGHT, camera_model="ortho",
            render_mode="RGB+D",
        )  # fmt: skip
        assert torch.allclose(meta["means2d"], torch.tensor([[30.5, 10.5]], **like), atol=2e-4)
        images.append(image[..., :3])
        assert abs(image[0, 10, 30, 3].item() - 0.9 * (2 + away)) < 1e-3
    assert torch.allclose(images[0], images[1], atol=1e-4) and torch.allclose(images[0], images[2], atol=1e-4)
    (images[0][..., WIDTH // 2 :, :].sum() + images[0][0, 10, 31].sum()).backward()
    assert mean.grad[0, 0] > 0 and mean.grad[0, 2].abs() < 1e-6


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"with_ut": True}, "with_ut is not supported; take camera_model='fisheye'"),
        ({"distributed": True}, "train with torchrun"),
        ({"sparse_grad": True, "packed": False}, "sparse_grad needs packed=True"),
        ({"radial_coeffs": torch.zeros(2, 4)}, "radial_coeffs is not supported"),
        ({"camera_model": "ftheta"}, "camera_model must be one of pinhole, fisheye, ortho, got 'ftheta'"),
        ({"eps2d": 1.5}, "eps2d must be 0 to 1 px.2, got 1.5"),
        ({"render_mode": "N"}, "render_mode must be one of RGB, D"),
        ({"render_mode": "RGB-Ed"}, r"render_mode 'RGB-Ed' needs with_eval3d, .*; take 'RGB\+ED'"),
        (
            {"sh_degree": 2, "colors": torch.zeros(60, 4, 3, dtype=DOUBLE)},
            r"colors of degree 2 must be \(..., 60, 9 or more, D\), got \(60, 4, 3\)",
        ),
        ({"sh_degree": 3}, r"colors of degree 3 must be \(..., 60, 16 or more, D\), got \(60, 3\)"),
        (
            {"extra_signals_sh_degree": 1, "extra_signals": torch.zeros(CAMERAS, 60, 5, dtype=DOUBLE)},
            r"extra_signals of degree 1 must be \(..., 60, 4 or more, D\), got \(2, 60, 5\)",
        ),
        (
            {"sh_degree": 1, "colors": torch.zeros(3, 60, 4, 3, dtype=DOUBLE)},
            r"colors must be \(60, 4, 3\), got \(3, 60, 4, 3\)",
        ),
        ({"colors": torch.zeros(60, 16, 3, dtype=DOUBLE)}, r"colors must be \(..., 60, D\), got \(60, 16, 3\)"),
        ({"backgrounds": torch.zeros(1, 3, dtype=DOUBLE)}, r"backgrounds must be \(2, 3\), got \(1, 3\)"),
        ({"backgrounds": torch.zeros(2, 4, dtype=DOUBLE)}, r"backgrounds must be \(2, 3\), got \(2, 4\)"),
        ({"viewmats": torch.eye(4, dtype=DOUBLE)}, r"viewmats must be \(1, 4, 4\), got \(4, 4\)"),
        (
            {"viewmats": torch.eye(4).repeat(CAMERAS, 1, 1)},
            "viewmats must be torch.float64 like means, got torch.float32",
        ),
        ({"viewmats": torch.zeros(0, 4, 4)}, r"there must be an image to render, got batches and cameras \(0,\)"),
        ({"means": [[0.0, 0, 1]]}, "means must be a tensor, got list"),
        ({"width": 0}, "width must be a whole number of 1 or more, got 0"),
        ({"height": torch.tensor(16.5)}, r"height must be a whole number of 1 or more, got tensor\(16.5"),
        ({"tile_size": 0}, "tile_size must be a whole number of 1 or more, got 0"),
        ({"sh_degree": 2.0}, "sh_degree must be a whole number of 0 or more, got 2.0"),
        ({"means": torch.zeros(3)}, r"means must be \(..., N, 3\), got \(3,\)"),
        ({"colors": None}, r"colors must be \(..., 60, D\), got None"),
        ({"backgrounds": torch.zeros(3, dtype=DOUBLE), "packed": False}, r"backgrounds must be \(2, 3\), got \(3,\)"),
    ],
)
def test_what_is_not_there_is_refused_by_name(options, words):
    with pytest.raises((ValueError, TypeError), match=words):
        Inputs(0).draw(**options)


def test_gsplats_renderers_are_known_by_name():
    kinds = [type("RendererConfig", (), {})]
    kinds += [type(f"RendererConfig_{name}", (kinds[0],), {}) for name in ("MixedBatch", "ParallelBatch", "Other")]
    given = Inputs(0)
    assert torch.equal(given.draw(renderer_config=kinds[1]())[0], given.draw()[0])
    wrong = (object(), TypeError), (kinds[2](), ValueError), (kinds[3](), NotImplementedError)
    for config, error in wrong:
        with pytest.raises(error, match="renderer_config|RendererConfig_Other"):
            given.draw(renderer_config=config)


def test_strategies_before_1_5_get_one_radius(monkeypatch):
    own = ModuleType("gsplat"), ModuleType("gsplat.rendering")
    own[0].rendering, own[0].__version__ = own[1], "1.4.0"
    for module in own:
        monkeypatch.setitem(sys.modules, module.__name__, module)
    programs.install()
    given = Inputs(1)
    rest = given.views, given.Ks, WIDTH, HEIGHT
    meta = own[1].rasterization(given.means, given.quats, given.scales, given.opacities, given.colors, *rest)[2]
    assert torch.equal(meta["radii"], given.draw()[2]["radii"].amax(-1)) and meta["radii"].dim() == 1


def test_parts_of_a_gaussian_follow_the_papers_double_sum():
    opacities, count = torch.tensor([0.3, 0.9, 0.5, 0.99, 0.2], dtype=DOUBLE), torch.tensor([1, 2, 5, 17, 80])
    most = 51
    binoms = torch.tensor([[math.comb(n, k) for k in range(most)] for n in range(most)], dtype=DOUBLE)
    parts, scales = programs.relocated(opacities, torch.ones(5, 3, dtype=DOUBLE), count, binoms, 0.0)
    for n, (opacity, number) in enumerate(zip(opacities.tolist(), count.clamp_max(most).tolist(), strict=True)):
        part = 1 - (1 - opacity) ** (1 / number)
        sums = (
            math.comb(i - 1, k) * (-1) ** k * part ** (k + 1) / math.sqrt(k + 1)
            for i in range(1, number + 1)
            for k in range(i)
        )
        assert parts[n].item() == pytest.approx(part)
        assert scales[n].tolist() == pytest.approx([opacity / math.fsum(sums)] * 3, rel=1e-6)
    assert programs.relocated(opacities, scales, count, binoms)[0].min() == 0.005


def test_a_gsplat_that_lacks_something_is_not_replaced(tmp_path, monkeypatch):
    (tmp_path / "gsplat").mkdir()
    (tmp_path / "gsplat" / "__init__.py").write_text("import jaxtyping_that_is_not_there\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "gsplat", raising=False)
    with pytest.raises(ModuleNotFoundError, match="jaxtyping_that_is_not_there"):
        programs.install()


@pytest.mark.parametrize("installed", [False, True])
def test_a_program_finds_it_by_gsplats_name(installed, tmp_path, monkeypatch, capsys):
    own = ModuleType("gsplat"), ModuleType("gsplat.rendering")
    for module, name in zip(own, ("gsplat", "gsplat.rendering"), strict=True):
        monkeypatch.setitem(sys.modules, name, module if installed else None)
    own[0].rendering = own[1]
    program = tmp_path / "program.py"
    (tmp_path / "beside_the_program.py").touch()
    monkeypatch.setattr(sys, "path", list(sys.path))
    program.write_text(
        "import sys\nimport beside_the_program\nfrom gsplat.rendering import rasterization\nimport gsplat\n"
        "print(gsplat.rasterization is rasterization, rasterization.__module__, sys.argv[1:])\n"
    )
    monkeypatch.setattr(sys, "argv", ["python -m", str(program), "--steps", "3"])
    programs.run()
    assert capsys.readouterr().out == "True diff_gaussian_rasterization.gsplat ['--steps', '3']\n"
    monkeypatch.setattr(sys, "argv", ["python -m"])
    with pytest.raises(SystemExit, match="name a program"):
        programs.run()
    monkeypatch.setattr(sys, "argv", ["python -m", "nowhere.py"])
    with pytest.raises(SystemExit, match="there is no program nowhere.py"):
        programs.run()
