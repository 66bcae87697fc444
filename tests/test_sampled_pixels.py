"""Exact pixels, popping and the chart of errors: against the oracle, against formulas by hand, and as commands."""

import math
import sys

import numpy as np
import pytest
import torch
from diff_gaussian_rasterization import Gaussians, reference
from gaussians import model
from PIL import Image

from benchmarks.accuracy import error_chart, popping, sampled_pixels
from benchmarks.accuracy.error_chart import jpeg_noise, tf32
from benchmarks.accuracy.sampled_pixels import blended, layers, random_pixels, sorted_view
from benchmarks.accuracy.splat_shapes import seen
from benchmarks.accuracy.trained_models import TrainedModel
from benchmarks.workloads.splat_scenes import PARAMETERS, frustum, on_device, settings
from utils.system_utils import UserError

WIDTH, HEIGHT = 40, 31


def scene(sigma_px: float = 3.0, count: int = 150) -> Gaussians:
    return Gaussians(**{name: frustum(count, WIDTH, HEIGHT, sigma_px, seed=1).parameters[name] for name in PARAMETERS})


@pytest.mark.parametrize("projection", ["ewa", "ray"])
@pytest.mark.parametrize("antialiasing", [False, True])
def test_colours_are_those_of_the_oracle(projection, antialiasing, monkeypatch):
    monkeypatch.setitem(sampled_pixels.AT_ONCE, "cpu", 2000)  # several chunks
    camera = settings(WIDTH, HEIGHT, projection=projection, antialiasing=antialiasing, principal=(0.1, -0.2))
    gaussians, pixels = scene(), random_pixels(camera, 50, seed=0)
    view = sorted_view(gaussians, camera, projection)
    found = layers(view, pixels)
    colors, used = blended(found, view.background)
    others = {name: values for name, values in gaussians._asdict().items() if values is not None}
    means, opacities = others.pop("means"), others.pop("opacities")
    drawn = reference.render(means, torch.zeros_like(means), opacities, camera, raw=True, **others)
    torch.testing.assert_close(colors, drawn.color[:, pixels[:, 1], pixels[:, 0]].T, rtol=0, atol=1e-13)
    assert 1 < used.sum(1).max() <= (found.alpha > 0).sum(1).max()
    again, still = blended(found, view.background, found.depth)
    assert torch.equal(again, colors) and torch.equal(still, used)


@pytest.mark.gpu
@pytest.mark.parametrize("projection", ["ewa", "ray"])
def test_a_gpu_finds_the_same(projection):
    if not torch.cuda.is_available():
        pytest.skip("needs a GPU")
    camera, colors, splats = settings(WIDTH, HEIGHT, projection=projection), {}, {}
    for device in ("cpu", "cuda"):
        gaussians = Gaussians(*(None if values is None else values.to(device) for values in scene()))
        there = on_device(camera, device)
        view = sorted_view(gaussians, there, projection)
        colors[device] = blended(layers(view, random_pixels(there, 50, seed=0)), view.background)[0].cpu()
        (splats[device],) = (torch.stack([*found[1:]]).cpu() for found in seen(gaussians, there))
    torch.testing.assert_close(colors["cuda"], colors["cpu"], rtol=0, atol=1e-12)
    torch.testing.assert_close(splats["cuda"], splats["cpu"], rtol=1e-11, atol=1e-12)


def test_a_gaussian_is_largest_on_a_ray_where_its_density_is():
    """Of a large Gaussian, whose dilation does not count, on its pixels' rays: by least squares along each ray."""
    camera = settings(WIDTH, HEIGHT)
    raw = scene(sigma_px=2000.0, count=1)
    view = sorted_view(raw, camera, "ewa")
    pixels = random_pixels(camera, 20, seed=0).double()
    along = sampled_pixels.depths_on_rays(view, pixels, torch.zeros(20, 1, dtype=torch.int64))[:, 0]
    q = torch.nn.functional.normalize(raw.rotations.double())
    turn = reference.shape.rotation_matrices(q)[0] / raw.scales.double().exp()[0]  # to whitened axes
    tan = torch.tensor([camera.tanfovx, camera.tanfovy])
    rays = ((2 * pixels + 1) / torch.tensor([WIDTH, HEIGHT]) - 1) * tan
    toward = torch.cat([rays, torch.ones(20, 1)], 1) @ turn
    mean = raw.means.double()[0] @ turn
    expected = (toward @ mean / toward.square().sum(1)).clamp(min=0)
    torch.testing.assert_close(along, expected, rtol=1e-4, atol=0)


def test_other_orders_and_cut_offs():
    color = torch.eye(3, dtype=torch.float64)[None]
    alpha, depth = torch.tensor([[0.5, 0.985, 0.99], [1, 2, 3]], dtype=torch.float64).split(1)
    found = sampled_pixels.Layers(torch.arange(3)[None], alpha, color, depth, depth.flip(1))
    black = torch.zeros(3).double()
    first, used = blended(found, black)
    assert first.tolist() == [pytest.approx([0.5, 0.4925, 0])] and used.tolist() == [[True, True, False]]
    assert blended(found, black, stop=0.0)[0].tolist() == [pytest.approx([0.5, 0.4925, 0.0075 * 0.99])]
    turned, used = blended(found, black, found.along)
    assert turned.tolist() == [pytest.approx([0, 0.01 * 0.985, 0.99])] and used.tolist() == [[False, True, True]]
    assert popping.is_inverted(found, torch.tensor([[True, True, False]])).tolist() == [True]
    assert popping.is_inverted(found._replace(along=depth), torch.tensor([[True] * 3])).tolist() == [False]


def test_lenses_are_refused():
    with pytest.raises(UserError, match="through pinholes only"):
        sorted_view(scene(), settings(WIDTH, HEIGHT)._replace(lens=object()), "ewa")


def test_a_turned_camera_sees_the_same_rays_elsewhere():
    camera = settings(WIDTH, HEIGHT, principal=(0.1, -0.2))
    turned = popping.moved(camera, 1.0, torch.zeros(3).double())
    pixels = random_pixels(camera, 10, seed=0)
    followed = popping.same_rays(pixels, camera, turned)
    focal = WIDTH / (2 * camera.tanfovx)
    assert followed[:, 0].sub(pixels[:, 0]).abs().mean() == pytest.approx(focal * math.radians(1), rel=0.2)
    means = torch.cat([torch.randn(5, 2, generator=torch.Generator().manual_seed(0)), torch.full((5, 1), 6.0)], 1)
    point = torch.cat([means.double(), torch.ones(5, 1)], 1)

    def pixel(of):
        clip = point @ of.projmatrix
        return ((clip[:, :2] / clip[:, 3:] + 1) * torch.tensor([WIDTH, HEIGHT]) - 1) / 2

    torch.testing.assert_close(popping.same_rays(pixel(camera), camera, turned), pixel(turned), rtol=1e-12, atol=1e-12)
    moved = popping.moved(camera, 0.0, torch.tensor([0.1, 0.2, 0.3]).double())
    assert (point @ moved.viewmatrix - point @ camera.viewmatrix)[0, :3].tolist() == pytest.approx([-0.1, -0.2, -0.3])


def test_a_turn_changes_the_order_of_means_alone_and_a_step_that_on_rays_alone(monkeypatch):
    monkeypatch.setattr(popping, "PIXELS", 60)
    view = torch.eye(4, dtype=torch.float64)
    view[0, 3] = -1
    cameras = [settings(WIDTH, HEIGHT), settings(WIDTH, HEIGHT, view=view)]
    found = popping.popping(TrainedModel("fog", scene(6.0, 400), cameras, []), "ray")
    assert found.differs.double().mean() > 0.9 and found.change.max() > 5
    jumps = {name: float(values.max()) for name, values in found.jumps.items()}
    assert jumps["turn of 1°", "means"] > 1 > 0.1 > jumps["turn of 1°", "rays"]  # of the dilation
    assert jumps["step", "means"] == 0 < jumps["step", "rays"]


def test_popping_prints_a_row_for_each_projection(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(popping, "PIXELS", 5)
    model(60).save_ply(tmp_path / "a.ply")
    monkeypatch.setattr(sys, "argv", ["popping", f"thin={tmp_path / 'a.ply'}"])
    popping.main()
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| thin")]
    assert [row.split("|")[2].strip() for row in rows] == ["ewa", "ray"]


def test_tf32_keeps_ten_bits():
    values = torch.randn(1000, generator=torch.Generator().manual_seed(0))
    rounded = tf32(values)
    assert 2**-12 < (rounded / values - 1).abs().max() <= 2**-11
    assert torch.equal(tf32(rounded), rounded)
    halves = torch.tensor([1 + 2**-11, 1 + 3 * 2**-11, 1 + 2**-11 + 2**-20, -1 - 3 * 2**-11])
    assert tf32(halves).tolist() == [1, 1 + 2**-9, 1 + 2**-10, -1 - 2**-9]


def test_noise_of_a_photo_is_that_of_its_quality(tmp_path):
    rng = np.random.default_rng(0)
    clean = np.add.outer(np.linspace(0, 150, 64), np.linspace(0, 80, 96))[..., None] + rng.normal(0, 8, (64, 96, 3))
    clean = clean.clip(0, 255).astype(np.uint8)
    for quality in (95, 60):
        path = tmp_path / f"{quality}.jpg"
        Image.fromarray(clean).save(path, quality=quality, subsampling=0)
        true = np.asarray(Image.open(path), float) - clean
        found = jpeg_noise(path, (96, 64))
        assert found.shape == (92 * 60, 3)
        assert 0.4 < 255 * float(found.square().mean().sqrt()) / np.sqrt((true**2).mean()) < 1.2
    assert len(jpeg_noise(path, (48, 32))) == 46 * 30
    Image.fromarray(clean).save(tmp_path / "a.png")
    assert jpeg_noise(tmp_path / "a.png", (96, 64)) is None


def test_errors_are_ranked_and_drawn(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(error_chart, "PIXELS", 30)
    monkeypatch.setattr(error_chart, "VIEWS", 2)
    model(60).save_ply(tmp_path / "a.ply")
    figure = tmp_path / "a.png"
    monkeypatch.setattr(sys, "argv", ["error_chart", f"thin={tmp_path / 'a.ply'}", "--figure", str(figure)])
    error_chart.main()
    said = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in said.splitlines() if line.startswith("| ")][1:]
    values = {row[0]: float(row[1]) for row in rows[1:]}
    assert list(values.values()) == sorted(values.values(), reverse=True)
    assert len(values) == 3 * 7 + 6
    assert values["bfloat16 means"] > 4 * values["TF32 means"] > 0
    assert values["8-bit output"] == pytest.approx(12**-0.5, rel=0.25)
    assert values["float32 arithmetic"] < 1e-2
    assert figure.stat().st_size > 10_000
