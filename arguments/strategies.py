"""Options of the strategies: how many Gaussians there are, and where, and how a run is paced."""

from arguments.param_group import Option, one_of

ADC_OPTIONS: tuple[Option, ...] = ()

MCMC_OPTIONS: tuple[Option, ...] = ()

BUDGET_OPTIONS: tuple[Option, ...] = ()

PACE_OPTIONS: tuple[Option, ...] = ()

_STRATEGY = Option(
    "strategy",
    "adc",
    "how many Gaussians there are, and where. adc: adaptive density control, the method's own",
    "ours",
    check=one_of("adc"),
)

STRATEGY_OPTIONS = (_STRATEGY, *ADC_OPTIONS, *MCMC_OPTIONS, *BUDGET_OPTIONS, *PACE_OPTIONS)
