"""Options of the strategies: how many Gaussians there are, and where, and how a run is paced."""

from arguments.param_group import Option, above, at_least, one_of, within

ADC_OPTIONS: tuple[Option, ...] = ()


def _between(value: float) -> str | None:
    return None if 0 < value < 1 else "between 0 and 1, and neither of them"


_PAPER = "ours, from the MCMC paper"
_RELEASED = "ours, from the release of the MCMC paper"

MCMC_OPTIONS: tuple[Option, ...] = (
    Option(
        "mcmc_until_iter",
        25_000,
        "mcmc: relocation and growth end before this step; --densify_until_iter has no effect then",
        _RELEASED,
        check=at_least(0),
    ),
    Option(
        "mcmc_growth",
        0.05,
        "mcmc: growth in every densification, as a part of the number of Gaussians",
        _PAPER,
        check=within(0, 1),
    ),
    Option(
        "mcmc_min_opacity",
        0.005,
        "mcmc: a Gaussian of this opacity or less is moved to another one",
        _PAPER,
        check=_between,
    ),
    Option(
        "mcmc_parts",
        51,
        "mcmc: largest number of parts for which opacity and scales of a divided Gaussian are corrected",
        _PAPER,
        check=within(2, 51),
    ),
    Option(
        "mcmc_noise",
        500_000.0,
        "mcmc: factor of the noise that moves Gaussians in every step, times the learning rate of positions",
        _PAPER,
        check=at_least(0),
    ),
    Option(
        "mcmc_gate_steepness",
        100.0,
        "mcmc: k of the factor sigmoid(-k (opacity - t)) of that noise; higher: less noise of opaque Gaussians",
        _PAPER,
        check=within(0, 10_000),
    ),
    Option(
        "mcmc_gate_opacity",
        0.005,
        "mcmc: t of that factor, the opacity with half of the noise",
        _PAPER,
        check=within(0, 1),
    ),
    Option(
        "mcmc_opacity_reg",
        0.01,
        "mcmc: weight of the mean opacity in the loss; higher: more Gaussians fade and are moved",
        _PAPER,
        check=at_least(0),
    ),
    Option(
        "mcmc_scale_reg",
        0.01,
        "mcmc: weight of the mean scale (world units) in the loss; higher: smaller Gaussians",
        _PAPER,
        check=at_least(0),
    ),
    Option(
        "mcmc_init_opacity",
        0.5,
        "mcmc: opacity of the Gaussians that are made from points",
        _RELEASED,
        check=_between,
    ),
    Option(
        "mcmc_init_scale",
        0.1,
        "mcmc: scale of the Gaussians that are made from points, as a part of the distance to their neighbours",
        _RELEASED,
        check=above(0),
    ),
)

BUDGET_OPTIONS: tuple[Option, ...] = ()

PACE_OPTIONS: tuple[Option, ...] = ()

_STRATEGY = Option(
    "strategy",
    "adc",
    "how many Gaussians there are, and where. adc: adaptive density control, the method's own; mcmc: Gaussians that "
    "nobody sees are moved to others, and positions get noise",
    "ours",
    check=one_of("adc", "mcmc"),
)

STRATEGY_OPTIONS = (_STRATEGY, *ADC_OPTIONS, *MCMC_OPTIONS, *BUDGET_OPTIONS, *PACE_OPTIONS)
