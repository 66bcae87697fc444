"""The strategy `budget`: scores against the oracle, fair draws, the growth curve, rows, and trainings to the byte."""

import math
from itertools import permutations
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from diff_gaussian_rasterization.reference import render as oracle
from gaussians import model, moments, options, parameters, pipeline, take_steps
from scipy import stats
from strategies import begun

import train
from gaussian_renderer import model_inputs, rasterizer_settings
from groundwork.deterministic.counter_rng import Stream
from groundwork.ranks.rows import WHOLE
from scene.cameras import MiniCam
from scene.gaussian_model import GaussianModel
from scene.gaussians.adc import remove_useless
from scene.gaussians.density_rules import band_rate, default_budget
from scene.gaussians.long_axis import long_axis_children
from scene.saved_model import read_model
from splatting.features.budget import Budget
from splatting.features.budget_rules import error_scores, fade, split_in_two
from splatting.features.time_budget_schedule import Block, Decided, DecidedSchedule
from splatting.objective import Objective
from splatting.part import Strategy
from splatting.registry import strategy_part
from splatting.schedule import STEADY, Schedule
from utils.graphics_utils import getProjectionMatrix
from utils.system_utils import UserError

WIDTH, HEIGHT = 23, 17
LEFT = slice(0, WIDTH // 2)
GREY = torch.tensor([0.2, 0.5, 0.1])


class View(MiniCam):
    """A small view at 3 units, with a photo of noise, and a mask or columns."""

    exposure_name, image_name = None, "photo"

    def __init__(self, masked: bool = False, columns: slice | None = None, seed: int = 0) -> None:
        world = torch.eye(4)
        world[0, 3], world[2, 3] = 0.1 * seed, 3.0
        projection = torch.as_tensor(getProjectionMatrix(0.01, 100.0, 0.8, 0.6)).float()
        super().__init__(
            WIDTH, HEIGHT, 0.6, 0.8, 0.01, 100.0, world.T.contiguous(), (projection @ world).T.contiguous()
        )
        rng = np.random.default_rng(seed)
        self.photo = torch.from_numpy(rng.integers(0, 256, (3, HEIGHT, WIDTH)).astype(np.uint8))
        self.mask = torch.from_numpy(rng.random((1, HEIGHT, WIDTH)) > 0.3) if masked else None
        self.columns = columns

    def ground_truth(self, background: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | None]:
        return self.photo, self.mask


def _weights(camera: View, gaussians: GaussianModel) -> tuple[np.ndarray, np.ndarray]:
    """The oracle's image over GREY (3, H, W), and the blending weight of each Gaussian at each pixel (N, H, W)."""
    inputs, raw = model_inputs(camera, gaussians, pipeline())
    settings = rasterizer_settings(camera, gaussians, pipeline(), GREY)
    screen, black = torch.zeros_like(inputs.means), settings._replace(bg=torch.zeros(3))
    with torch.no_grad():
        image = oracle(means2d=screen, settings=settings, raw=raw, **inputs._asdict()).color
        weights = []
        for one in torch.eye(len(screen))[:, :, None].expand(-1, -1, 3):  # one Gaussian is white
            white = inputs._replace(colors=one.contiguous(), sh_dc=None, sh_rest=None)
            weights.append(oracle(means2d=screen, settings=black, raw=raw, **white._asdict()).color[0])
    return image.numpy(), torch.stack(weights).numpy()


@pytest.mark.parametrize("case", ["plain", "mask", "columns", "mask and columns", "exposure"])
def test_scores_are_those_of_a_slow_sum_over_pixels(case):
    camera = View("mask" in case, LEFT if "columns" in case else None)
    gaussians = model(14, extent=1.0, seed=3)
    with torch.no_grad():
        gaussians.raw("f_dc")[::4] = -9.0  # drawn black; their scores do not follow colours
    if case == "exposure":
        gaussians.start_exposures([SimpleNamespace(image_name="photo")])
        with torch.no_grad():
            gaussians.exposures.values += 0.2 * torch.randn(1, 3, 4, generator=torch.Generator().manual_seed(1))
    scores = error_scores(gaussians, pipeline(), case == "exposure", [camera], GREY)
    image, weights = _weights(camera, gaussians)
    if case == "exposure":
        matrix = gaussians.get_exposure_from_name("photo").detach().double().numpy()
        image = np.einsum("jhw,ji->ihw", image, matrix[:, :3]) + matrix[:, 3, None, None]
    counting = np.ones((HEIGHT, WIDTH), bool) if camera.mask is None else camera.mask[0].numpy().copy()
    of_half = 1.0
    if camera.columns is not None:
        counting[:, camera.columns.stop :] = False
        of_half = camera.columns.stop / WIDTH
    expected = np.zeros(len(gaussians))
    for row, column in np.argwhere(counting):
        pixel = image[:, row, column] - camera.photo[:, row, column].numpy() / 255.0
        expected += weights[:, row, column] * np.abs(pixel).mean() * of_half / counting.sum()
    assert (expected > 1e-6).sum() >= 8
    np.testing.assert_allclose(scores.numpy(), expected, rtol=2e-4, atol=1e-7)


# Draws


def _drawn(weights: list[float], count: int, iteration: int, seed: int = 0) -> list[int]:
    chosen = WHOLE.choose(torch.tensor(weights, dtype=torch.float64), count, seed=seed, stream=Stream.DENSIFY,
                             iteration=iteration)  # fmt: skip
    return chosen.tolist()


@pytest.mark.slow
def test_pairs_are_drawn_as_often_as_one_after_the_other():
    weights, draws = [1.0, 2.0, 4.0, 0.0, 1.5], 2000
    total = sum(weights)
    expected = dict.fromkeys([(a, b) for a in range(5) for b in range(a + 1, 5) if 3 not in (a, b)], 0.0)
    for first, second in permutations([0, 1, 2, 4], 2):
        chance = weights[first] / total * weights[second] / (total - weights[first])
        expected[min(first, second), max(first, second)] += chance
    found = dict.fromkeys(expected, 0)
    for iteration in range(draws):
        found[tuple(_drawn(weights, 2, iteration))] += 1  # KeyError for item 3, which has no weight
    # The numbers are fixed, so the p-value is a constant; a value below 1e-3 would mean a fault.
    assert stats.chisquare(list(found.values()), [draws * chance for chance in expected.values()]).pvalue > 1e-3
    best_only = sum(found[key] for key in found if 2 in key)
    assert best_only < draws  # not the highest scores alone


def _control(schedule: Schedule = STEADY, strategy: str = "budget", **changes: object) -> Strategy:
    """The strategy of a run with four large views."""
    opt, views = options(strategy=strategy), [SimpleNamespace(image_width=6400, image_height=1000)] * 4
    vars(opt).update(changes)
    return begun(strategy, opt=opt, schedule=schedule, cameras=views)


def test_draws_of_nothing_of_all_and_of_broken_weights():
    assert _drawn([0.0, 0.0], 5, 1) == [] and _drawn([], 5, 1) == [] and _drawn([1.0, 2.0], 0, 1) == []
    assert _drawn([1.0, 0.0, 2.0], 2, 1) == [0, 2] and _drawn([1.0, 2.0], -3, 1) == []
    assert _drawn([math.nan, 1.0, math.inf, -1.0], 9, 1) == [1]
    assert _drawn([1e-300, 1e-320], 1, 1) in ([0], [1])  # far below what float32 holds
    assert len({tuple(_drawn([1.0] * 20, 5, iteration, seed)) for iteration in range(3) for seed in range(3)}) == 9


# Rows


def test_a_pace_that_quickens_before_the_last_densification_leaves_none_missing():
    blocks = [Block(80, 0.0, 11 / 2000, 0.0), Block(160, 0.44, 13 / 2000, 0.0)]
    # The window begins so early that the interval stays.
    window = {"densification_interval": 10, "densify_from_iter": -1700, "densify_until_iter": 1000}
    control = _control(DecidedSchedule(Decided(2000, blocks, None, 9.0)), **window, max_num_splats=1000)
    # At the pace of the 80th, the 90th comes just in time.
    due = [iteration for iteration in range(1, 160) if control.actions(iteration).densify]
    assert max(due) == 80 and control._next_count(900, 80) == 1000


def test_a_split_leaves_other_rows_alone_and_restarts_averages():
    gaussians, parents = model(20), torch.tensor([2, 3, 11])
    take_steps(gaussians, 3)
    before, averages = parameters(gaussians), moments(gaussians)
    split_in_two(gaussians, parents[:0])
    assert torch.equal(gaussians.get_xyz, before["xyz"])
    split_in_two(gaussians, parents)
    after, then = parameters(gaussians), moments(gaussians)
    assert len(gaussians) == len(gaussians.xyz_gradient_accum) == 23
    others = torch.tensor([row for row in range(20) if row not in parents])
    family = torch.cat((parents, torch.arange(20, 23)))
    children = long_axis_children(*(before[name][parents] for name in ("xyz", "scaling", "rotation", "opacity")))
    for name, values in after.items():
        assert torch.equal(values[others], before[name][others])
        assert torch.equal(values[family], children[name] if name in children else before[name][parents].repeat(
            2, *[1] * (values.dim() - 1)))  # fmt: skip
        for key in ("exp_avg", "exp_avg_sq"):
            assert torch.equal(then[name][key][others], averages[name][key][others]) and averages[name][key].any()
            assert not then[name][key][family].any()
        assert then[name]["step"] == averages[name]["step"]


def test_useless_and_surplus_gaussians_go():
    gaussians = model(6)
    with torch.no_grad():
        gaussians.raw("opacity").copy_(torch.tensor([0.9, 0.004, 0.3, 0.006, 0.3, 0.2])[:, None].logit())
    remove_useless(gaussians, 0.005, 9)
    assert len(gaussians) == 5
    remove_useless(gaussians, 0.005, 3)
    torch.testing.assert_close(gaussians.get_opacity[:, 0].detach(), torch.tensor([0.9, 0.3, 0.3]))
    remove_useless(gaussians, 0.0, 3)
    assert len(gaussians) == 3


def test_fading_multiplies_opacities_and_keeps_averages():
    gaussians = model(200)
    with torch.no_grad():
        gaussians.raw("opacity")[:3, 0] = torch.tensor([40.0, -40.0, 12.0])
    take_steps(gaussians, 1)
    averages, parameter = moments(gaussians)["opacity"], gaussians.raw("opacity")
    expected = torch.logit(0.98 * torch.sigmoid(parameter.detach().double()))
    fade(gaussians, 0.98)
    torch.testing.assert_close(parameter.detach().double(), expected, rtol=3e-7, atol=3e-7)
    assert torch.equal(moments(gaussians)["opacity"]["exp_avg"], averages["exp_avg"])
    kept = parameter.detach().clone()
    fade(gaussians, 1.0)
    assert gaussians.raw("opacity") is parameter and torch.equal(parameter, kept)


# Trainings

GROWING = [
    "--strategy", "budget", "--densify_from_iter", 20, "--densification_interval", 20, "--densify_until_iter", 130,
    "--disable_viewer",
]  # fmt: skip
SMALL = ["-r", 48, "--test_iterations", -1, "--no_curve"]


def _train(scene: Path, out: Path, *more: object, iterations: int = 160) -> Path:
    given = ["-s", scene, "-m", out, "--iterations", iterations, *SMALL, *GROWING, "--keep_unseen", *more]
    train.main(list(map(str, given)))
    return out / "point_cloud" / f"iteration_{iterations}" / "point_cloud.ply"


@pytest.fixture
def counts(monkeypatch) -> list[tuple[int, int]]:
    """Iteration and number of Gaussians after each densification."""
    found, after_step = [], Budget.after_step

    def note(control, step) -> None:
        after_step(control, step)
        if step.density.densify:
            found.append((step.iteration, len(control._gaussians)))

    monkeypatch.setattr(Budget, "after_step", note)
    return found


@pytest.mark.parametrize(("strategy", "clamped"), [("adc", True), ("budget", False), ("mcmc", False)])
def test_the_loss_sees_what_is_brighter_than_white(strategy, clamped):
    """Unlike the reference's. Else Gaussians brighter than a white background float before it, and hide test views."""
    bright = torch.full((3, HEIGHT, WIDTH), 1.5, requires_grad=True)
    step = SimpleNamespace(camera=View(), background=GREY, terms={})
    run = SimpleNamespace(opt=options(), strategy=strategy_part(strategy), pixel_filter=None, gaussians=model(1))
    Objective(run)({"render": bright}, step).total.backward()
    assert bool(bright.grad.any()) != clamped


def test_the_cap_is_reached_and_held(colmap_scene, tmp_path, counts):
    ply = _train(colmap_scene, tmp_path / "out", "--max_num_splats", 700)
    assert [iteration for iteration, _ in counts] == [20, 40, 60, 80, 100, 120]
    numbers = [count for _, count in counts]
    assert numbers == sorted(numbers) and numbers[0] == 300 and numbers[-1] == 700 == len(read_model(ply))
    assert numbers[1:] == [300 + 80 * k for k in range(1, 6)]


# So short a training multiplies rates by 8. At 0.2, with sparse Adam, Gaussians vanish faster than they double.
def test_an_empty_model_is_an_error(colmap_scene, tmp_path):
    with pytest.raises(UserError, match="no Gaussian was left after the densification of iteration 20: .*--prune_opac"):
        _train(colmap_scene, tmp_path / "out", "--prune_opacity", 0.5, "--opacity_lr", 0.003)  # times 8


def test_the_default_budget_follows_the_pixels():
    def budget_of(views: int, width: int) -> int:
        return default_budget([SimpleNamespace(image_width=width, image_height=500)] * views)

    assert (budget_of(7, 500), budget_of(40, 300), budget_of(100, 4000)) == (100_000, 100_000, 1_000_000)


def test_the_default_budget_follows_the_iterations_that_the_clock_allows():
    def aim(given: int, stride: float) -> int:
        """Return the number of Gaussians to have after the last densification, whatever there is before."""
        decided = Decided(30_000, [Block(15_000, 0.0, stride / 30_000, 0.0)], None, 9.0)
        return _control(DecidedSchedule(decided), max_num_splats=given)._next_count(10_000, int(14_999 / stride))

    assert (aim(0, 10.0), aim(0, 2.0), aim(0, 1.0)) == (25 * 3000, 25 * 15_000, 400_000)
    assert (aim(123_456, 10.0), aim(20_000, 10.0)) == (25 * 3000, 20_000)  # a given number has the same bound


@pytest.mark.parametrize(("iterations", "beta2"), [(30_000, 0.995), (7_500, 0.99), (300, 0.95), (10, 1 - 1 / 16)])
def test_fewer_iterations_average_squared_gradients_over_fewer(iterations, beta2):
    block = Block(iterations, 0.0, 1 / iterations, 0.0)
    for schedule in (Schedule(iterations), DecidedSchedule(Decided(30_000, [block], iterations, 0.0))):
        assert begun("budget", schedule=schedule).rates(iterations).beta2 == pytest.approx(beta2)


def test_bands_learn_slowly_from_few_photos():
    assert [band_rate([None] * count) for count in (10, 50, 75, 100, 1000)] == [0.2, 1.0, 1.5, 2.0, 2.0]
    assert begun("budget", schedule=Schedule(9)).rates(1).bands == begun("mcmc").rates(1).bands < 1
