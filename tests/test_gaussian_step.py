"""The backward that steps the Gaussians itself, against gradients in memory, `adam_` and `observe_`: equal bytes."""

import math
from dataclasses import dataclass, field, replace

import pytest
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, schema
from rasterizer_tools import BOTH_AND_GPU, activated, ops, scene_arguments
from torch import Tensor

from benchmarks.workloads.splat_scenes import PARAMETERS, frustum

BETAS, EPS = (0.9, 0.999), 1e-15
RATES = [1e-4, 0.05, 0.005, 0.001, 0.0025, 0.000125]


@dataclass
class State:
    """What a step changes: values and averages by attribute, counters, statistics, the guard's flag."""

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

    def copy(self) -> "State":
        return State(
            {name: t.clone() for name, t in self.values.items()},
            [[t.clone() for t in tensors] for tensors in self.averages],
            [t.clone() for t in self.counters],
            [t.clone() for t in self.statistics],
            self.stopped.clone(),
        )


@dataclass
class Case:
    """How a step is taken. attributes: those that take one; columns: of sh_rest."""

    sparse: bool = False
    guarded: bool = False
    observed: bool = True
    attributes: tuple[int, ...] = (0, 1, 2, 3, 4, 5)
    columns: int = -1
    degree: int = 3
    antialiasing: bool = False
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
    """Arguments that both backwards have in common, then the radii."""
    scene = scene_arguments(state.values, camera, case.raw)
    out = ops.rasterize(None, *scene, camera.bg, True, True)
    color, transmittance, inverse_depth, radii, splats, counts, *lists, last, layers = out
    generator = torch.Generator().manual_seed(iteration)
    planes = [torch.randn(t.shape, generator=generator).to(t) for t in (color, transmittance, inverse_depth)]
    if iteration == 2:
        planes[0][0, color.shape[1] // 2, color.shape[2] // 2] *= case.broken
    if not case.depth:
        planes[1:] = None, None
    return (*scene, splats, *lists, camera.bg, last, transmittance, *planes, counts, layers), radii


def step_plainly(state: State, camera: GaussianRasterizationSettings, case: Case, iteration: int) -> None:
    """Take one iteration's step from gradients in memory."""
    arguments, radii = rendered(state, camera, case, iteration)
    wanted = [name in ("means2d", *PARAMETERS) for name in schema.GRADIENTS]
    gradients = dict(zip(schema.GRADIENTS, ops.rasterize_vjp(*arguments, wanted, case.absolute), strict=True))
    if any(case.penalties):
        penalised = "opacities", "scales"
        of = [state.values[name] for name in penalised], [gradients[name] for name in penalised]
        ops.penalise_(*of[0], *of[1], *case.penalties)
    if case.observed:
        screen = gradients["means2d"]
        ops.observe_(*state.statistics, radii, screen[:, 2] if case.absolute else screen)
    names = [PARAMETERS[place] for place in case.attributes]
    values, gradients = [state.values[name] for name in names], [gradients[name] for name in names]
    guard = case.guard(state, iteration)
    if not names:
        return
    if not case.sparse:
        ops.adam_(values, gradients, *case.lists(state), *guard)
        return
    *lists, beta1, beta2, eps, columns = case.lists(state)
    for value, gradient, mean, square, counter, rate, count in zip(values, gradients, *lists, columns, strict=True):
        counter += 1
        ops.sparse_adam_(value, gradient, mean, square, radii > 0, rate, beta1, beta2, eps, count, *guard)


def step_fused(state: State, camera: GaussianRasterizationSettings, case: Case, iteration: int) -> None:
    """Take the same step inside the backward."""
    arguments, radii = rendered(state, camera, case, iteration)
    ops.rasterize_vjp_step_(*arguments, radii, *rest_of(case, state, iteration), **named_rest_of(case))


def step_from_rows(state: State, camera: GaussianRasterizationSettings, case: Case, iteration: int) -> None:
    """Take the same step from gradient rows."""
    arguments, radii = rendered(state, camera, case, iteration)
    scene, given = scene_and_rows(arguments, case)
    ops.rows_vjp_step_(*scene, *given, radii, *rest_of(case, state, iteration), **named_rest_of(case))


def scene_and_rows(arguments: tuple, case: Case) -> tuple[tuple, tuple]:
    """The arguments of the scene and of its rows, from those of a backward from lists."""
    *backward, counts, layers = arguments[len(schema.SCENE) :]
    return arguments[: len(schema.SCENE)], (backward[0], counts, *ops.blend_rows(*backward, layers, case.absolute))


def rest_of(case: Case, state: State, iteration: int) -> tuple:
    """The arguments of a step after the radii, up to the guard's."""
    statistics = state.statistics if case.observed else (None, None, None)
    return case.attributes, *case.lists(state), case.sparse, *statistics, *case.guard(state, iteration)


def named_rest_of(case: Case) -> dict:
    """The arguments of a step behind the guard's."""
    opacity, scale = case.penalties
    return {"absolute": case.absolute, "opacity_penalty": opacity, "scale_penalty": scale}


def step_recorded(state: State, camera: GaussianRasterizationSettings, case: Case, iteration: int) -> None:
    """Take the same step by numbers that the device's memory holds; those of the call are wrong."""
    _, _, steps, rates, *constants, columns = case.lists(state)
    host = torch.zeros(22, dtype=torch.int64)
    arguments, radii = rendered(state, camera, case, iteration)
    ops.step_now_(host, case.attributes, steps, rates, *constants, case.sparse, iteration)
    statistics = state.statistics if case.observed else (None, None, None)
    guard = case.guard(state, iteration)
    averages = case.lists(state)[:2]
    wrong = [t + 5 for t in steps], [2.0 * rate for rate in rates], 0.5, 0.5, 1.0
    last = (*guard[:2], 77) if guard else (None, None, 77)
    ops.rasterize_vjp_step_(
        *arguments, radii, case.attributes, *averages, *wrong, columns, case.sparse, *statistics, *last,
        host.to(radii.device), case.absolute, *case.penalties,
    )  # fmt: skip


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
    "sparse penalty": Case(penalties=(0.3, 0.0), sparse=True, guarded=True, absolute=True),
}


# No Gaussian, one, and more than vectors of 16 and blocks of 128 hold, with bands of harmonics that none reads.
CASES |= {
    f"{count} of {bands} bands": Case(degree=degree, count=count, bands=bands)
    for count in (0, 1, 31, 129)
    for degree, bands in enumerate((0, 3, 15))
}


def start_and_camera(case: Case, device: str, dtype: torch.dtype) -> tuple[State, GaussianRasterizationSettings]:
    scene = frustum(case.count, 77, 51, 4.0, seed=7)
    values = {name: scene.parameters[name].float() for name in PARAMETERS}
    values["means"] = values["means"] * torch.tensor([1.6, 1.6, 1.0])  # some are not seen
    values["sh_rest"] = values["sh_rest"][:, : case.bands]
    values = values if case.raw else activated(values)
    state = State.start({name: t.to(device, dtype).contiguous() for name, t in values.items()})
    camera = scene.to(device).settings(dtype, sh_degree=case.degree, antialiasing=case.antialiasing)
    return state, camera


@BOTH_AND_GPU
@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_every_form_has_the_bytes_of_the_plain_step(case, device, dtype):
    steps = [step_plainly, step_fused, step_from_rows, step_recorded]
    if dtype == torch.float64:  # neither statistics nor numbers in memory are of it
        case, steps = replace(case, observed=False), steps[:3]
    start, camera = start_and_camera(case, device, dtype)
    forms = {step: start.copy() for step in steps}
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
