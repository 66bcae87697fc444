"""The backward that steps the Gaussians itself, against gradients in memory, `adam_` and `observe_`: equal bytes."""

import math
from copy import deepcopy
from dataclasses import dataclass, field, replace

import pytest
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings
from diff_gaussian_rasterization.density import penalise_
from diff_gaussian_rasterization.lens import Lens
from diff_gaussian_rasterization.ops import gradients_of
from diff_gaussian_rasterization.optim import adam_, observe_, sparse_adam_
from diff_gaussian_rasterization.scene import GRADIENTS, draw
from rasterizer_tools import BOTH_AND_GPU, activated, ops, scene_arguments
from torch import Tensor

from tests.workloads.splat_scenes import PARAMETERS, frustum

BETAS, EPS = (0.9, 0.999), 1e-15
FISHEYE = Lens("equidistant", (40.0, 40.0), (38.0, 25.0))
RATES = [1e-4, 0.05, 0.005, 0.001, 0.0025, 0.000125]


@dataclass
class State:
    """The state that a step changes: values and averages by attribute, counters, statistics, the guard's flag."""

    values: dict[str, Tensor]
    averages: list[list[Tensor]] = field(default_factory=list)
    counters: list[Tensor] = field(default_factory=list)
    statistics: list[Tensor] = field(default_factory=list)
    stopped: Tensor | None = None

    @classmethod
    def start(cls, values: dict[str, Tensor]) -> "State":
        generator = torch.Generator().manual_seed(1)

        def random(like: Tensor) -> Tensor:
            return torch.randn(like.shape, generator=generator, dtype=torch.float64).to(like)

        averages = [[1e-4 * random(v) for v in values.values()], [1e-6 * random(v) ** 2 for v in values.values()]]
        counters = [torch.tensor(float(3 + place)) for place in range(6)]
        means = values["means"]
        statistics = [random(means[:, :1]).float().abs() for _ in range(3)]
        return cls(values, averages, counters, statistics, torch.zeros(1, dtype=torch.int64, device=means.device))

    def tensors(self) -> list[Tensor]:
        averages = [t for tensors in self.averages for t in tensors]
        return [*self.values.values(), *averages, *self.counters, *self.statistics, self.stopped]


@dataclass
class Case:
    """A way to take a step.

    attributes: attributes that take one.
    columns: columns of sh_rest.
    """

    sparse: bool = False
    guarded: bool = False
    observed: bool = True
    attributes: tuple[int, ...] = (0, 1, 2, 3, 4, 5)
    columns: int = -1
    degree: int = 3
    antialiasing: bool = False
    projection: str = "ewa"
    lens: Lens | None = None
    raw: bool = True
    depth: bool = False
    absolute: bool = False  # the statistics take lengths of absolute gradients
    penalties: tuple[float, float] = (0.0, 0.0)  # of opacities and of scales
    broken: float = 1.0  # the factor of a pixel's gradient in the second iteration
    loss: float = 0.5
    count: int = 700
    bands: int = 15  # of sh_rest

    def lists(self, state: State) -> tuple:
        """Adam's arguments from the first averages on, of the attributes that take a step."""
        columns = [*[-1] * 5, self.columns]
        every = *state.averages, state.counters, RATES
        return (
            *([of[place] for place in self.attributes] for of in every),
            *BETAS,
            EPS,
            [columns[place] for place in self.attributes],
        )

    def guard(self, state: State, iteration: int) -> tuple:
        loss = torch.tensor(self.loss).to(state.values["means"])
        return (loss, state.stopped, iteration) if self.guarded else ()


def rendered(state: State, camera: GaussianRasterizationSettings, case: Case, iteration: int) -> tuple:
    """The scene, what the forward has kept, gradients of its planes, and the radii."""
    scene = scene_arguments(state.values, camera, case.raw)
    drawn = draw(scene, camera.bg, True)
    generator = torch.Generator().manual_seed(iteration)
    planes = [torch.randn(t.shape, generator=generator).to(t) for t in drawn[:3]]
    if iteration == 2:
        planes[0][0, planes[0].shape[1] // 2, planes[0].shape[2] // 2] *= case.broken
    if not case.depth:
        planes[1:] = None, None
    return scene, drawn.kept(camera.bg), planes, drawn.radii


def step_plainly(state: State, camera: GaussianRasterizationSettings, case: Case, iteration: int) -> None:
    """Take one iteration's step from gradients in memory."""
    *arguments, radii = rendered(state, camera, case, iteration)
    needed = [name in ("means2d", *PARAMETERS) for name in GRADIENTS]
    gradients = dict(zip(GRADIENTS, gradients_of(*arguments, needed, case.absolute), strict=True))
    if any(case.penalties):
        penalised = "opacities", "scales"
        of = [state.values[name] for name in penalised], [gradients[name] for name in penalised]
        penalise_(*of[0], *of[1], opacity=case.penalties[0], scale=case.penalties[1])
    if case.observed:
        screen = gradients["means2d"]
        observe_(*state.statistics, radii, screen[:, 2] if case.absolute else screen)
    names = [PARAMETERS[place] for place in case.attributes]
    values, gradients = [state.values[name] for name in names], [gradients[name] for name in names]
    guard = case.guard(state, iteration)
    if not names:
        return
    if not case.sparse:
        adam_(values, gradients, *case.lists(state), *guard)
        return
    *lists, beta1, beta2, eps, columns = case.lists(state)
    for value, gradient, mean, square, counter, rate, count in zip(values, gradients, *lists, columns, strict=True):
        counter += 1
        sparse_adam_(value, gradient, mean, square, radii > 0, rate, beta1, beta2, eps, count, *guard)


def step_fused(state: State, camera: GaussianRasterizationSettings, case: Case, iteration: int) -> None:
    """Take the same step inside the backward."""
    scene, kept, planes, radii = rendered(state, camera, case, iteration)
    ops.apply_gradients_(*scene.lists, kept, planes, radii=radii, **named(case, state, iteration))


def step_from_rows(state: State, camera: GaussianRasterizationSettings, case: Case, iteration: int) -> None:
    """Take the same step from gradient rows."""
    scene, kept, planes, radii = rendered(state, camera, case, iteration)
    source = *kept[:2], *ops.blend_rows(kept, *planes, case.absolute)
    ops.apply_gradients_(*scene.lists, source, [], radii=radii, **named(case, state, iteration))


def named(case: Case, state: State, iteration: int) -> dict:
    """The arguments of a step besides the radii."""
    means, squares, steps, rates, *constants, columns = case.lists(state)
    *guard, number = case.guard(state, iteration) or (0,)
    return {
        "averages": means + squares, "steps": steps, "rates": rates, "columns": columns, "absolute": case.absolute,
        "constants": [*constants, *case.penalties], "attributes": case.attributes, "sparse": case.sparse,
        "statistics": state.statistics if case.observed else [], "guard": guard, "iteration": number,
    }  # fmt: skip


def step_recorded(state: State, camera: GaussianRasterizationSettings, case: Case, iteration: int) -> None:
    """Take the same step by numbers that the device's memory holds; those of the call are wrong."""
    _, _, steps, rates, *constants, _ = case.lists(state)
    host = torch.zeros(23, dtype=torch.int64)
    scene, kept, planes, radii = rendered(state, camera, case, iteration)
    ops.step_now_(host, case.attributes, steps, rates, *constants, case.sparse, iteration)
    wrong = {"steps": [t + 5 for t in steps], "rates": [2.0 * rate for rate in rates], "iteration": 77}
    wrong["constants"] = [0.5, 0.5, 1.0, *case.penalties]
    given = named(case, state, iteration) | wrong | {"now": host.to(radii.device)}
    ops.apply_gradients_(*scene.lists, kept, planes, radii=radii, **given)


def same_bytes(one: Tensor, other: Tensor) -> bool:
    return one.cpu().numpy().tobytes() == other.cpu().numpy().tobytes()


CASES = {
    "dense": Case(),
    "sparse": Case(sparse=True),
    "unobserved": Case(observed=False),
    "guarded": Case(guarded=True),
    "guarded sparse": Case(guarded=True, sparse=True),
    "NaN": Case(guarded=True, broken=math.nan),
    "sparse NaN": Case(guarded=True, sparse=True, broken=math.inf),
    "unguarded NaN": Case(broken=math.nan),
    "huge gradient": Case(guarded=True, broken=1e200),
    "NaN loss": Case(guarded=True, loss=math.nan),
    "no bands": Case(degree=0, columns=0),
    "one band": Case(degree=1, columns=9),
    "sparse, two bands": Case(degree=2, columns=24, sparse=True),
    "inactive bands step": Case(degree=1),
    "one band, guarded": Case(degree=1, columns=9, guarded=True, broken=math.nan),
    "after a reset": Case(attributes=(0, 2, 3, 4, 5)),
    "only statistics": Case(attributes=()),
    "antialiased": Case(antialiasing=True),
    "activated": Case(raw=False),
    "depth": Case(depth=True, guarded=True),
    "absolute": Case(absolute=True),
    "absolute, sparse, depth": Case(absolute=True, sparse=True, guarded=True, depth=True),
    "absolute, only statistics": Case(absolute=True, attributes=()),
    "absolute, unobserved": Case(absolute=True, observed=False),
    "absolute NaN": Case(absolute=True, guarded=True, broken=math.nan),
    "penalties": Case(penalties=(0.3, 0.2)),
    "rays": Case(projection="ray", guarded=True, depth=True),
    "rays of a lens": Case(projection="ray", lens=FISHEYE, guarded=True, depth=True),
    "rays of a lens, absolute": Case(projection="ray", lens=FISHEYE, absolute=True, antialiasing=True),
    "rays, absolute": Case(projection="ray", absolute=True, sparse=True, antialiasing=True),
    "sparse penalty": Case(penalties=(0.3, 0.0), sparse=True, guarded=True, absolute=True),
}


# No Gaussian, one, and more than vectors of 16 and blocks of 128 hold, with bands of harmonics that none reads.
CASES |= {
    f"{count} of {bands} bands": Case(degree=degree, count=count, bands=bands)
    for count, degree, bands in [(0, 1, 3), (1, 2, 15), (31, 0, 0), (129, 1, 3)]
}


def start_and_camera(case: Case, device: str, dtype: torch.dtype) -> tuple[State, GaussianRasterizationSettings]:
    scene = frustum(case.count, 77, 51, 4.0, seed=7)
    values = {name: scene.parameters[name].float() for name in PARAMETERS}
    values["means"] = values["means"] * torch.tensor([1.6, 1.6, 1.0])  # some are not seen
    values["sh_rest"] = values["sh_rest"][:, : case.bands]
    values = values if case.raw else activated(values)
    state = State.start({name: t.to(device, dtype).contiguous() for name, t in values.items()})
    how = {"sh_degree": case.degree, "antialiasing": case.antialiasing, "projection": case.projection}
    how["lens"] = case.lens
    camera = scene.to(device).settings(dtype, **how)
    return state, camera


@BOTH_AND_GPU
@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_every_form_has_the_bytes_of_the_plain_step(case, device, dtype):
    steps = [step_plainly, step_fused, step_from_rows, step_recorded]
    if dtype == torch.float64:  # neither statistics nor numbers in memory are of it
        case, steps = replace(case, observed=False), steps[:3]
    if case.lens:  # of which there are no gradient rows
        steps.remove(step_from_rows)
    start, camera = start_and_camera(case, device, dtype)
    forms = {step: deepcopy(start) for step in steps}
    for iteration in (1, 2, 3):
        for step, state in forms.items():
            step(state, camera, case, iteration)
        for step, state in forms.items():
            pairs = zip(state.tensors(), forms[step_plainly].tensors(), strict=True)
            assert all(same_bytes(*pair) for pair in pairs), (step.__name__, iteration)
    if case.attributes and math.isfinite(case.loss) and case.count > 1:
        assert not torch.equal(state.values["means"], start.values["means"])
    if case.guarded:
        assert int(state.stopped) == (1 if math.isnan(case.loss) else 0 if case.broken == 1 else 2)
