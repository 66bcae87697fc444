"""Options of the strategies: how many Gaussians there are, and where, and how a run is paced."""

from arguments.param_group import Option, at_least, one_of

ADC_OPTIONS: tuple[Option, ...] = ()

MCMC_OPTIONS: tuple[Option, ...] = ()

BUDGET_OPTIONS: tuple[Option, ...] = ()

PACE_OPTIONS: tuple[Option, ...] = (
    Option(
        "time_budget",
        0.0,
        "seconds of training that the run takes, without scoring and saving, to 3 %; 0: no budget. It goes through the "
        "whole schedule of --iterations in them, in fewer or more iterations, and writes schedule.json",
        "ours",
        check=at_least(0),
    ),
    Option(
        "schedule",
        "",
        "schedule.json of a run with --time_budget: train as that run did, without looking at the clock",
        "ours",
    ),
)

_STRATEGY = Option(
    "strategy",
    "adc",
    "how many Gaussians there are, and where. adc: adaptive density control, the method's own",
    "ours",
    check=one_of("adc"),
)

STRATEGY_OPTIONS = (_STRATEGY, *ADC_OPTIONS, *MCMC_OPTIONS, *BUDGET_OPTIONS, *PACE_OPTIONS)
