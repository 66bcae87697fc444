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
        "resolution_schedule",
        "none",
        "smaller views at first, so that the first iterations take less time. pyramid: a quarter of the size up to "
        "10 % of the schedule, half of it up to 25 %; spectrum: sizes by how fine the photos' detail is",
        "ours",
        check=one_of("none", "pyramid", "spectrum"),
    ),
    Option(
        "target_psnr",
        0.0,
        "stop, and save, once the mean PSNR (dB) of the test views (--eval) is at least this; 0: no target. They are "
        "scored every 100 iterations, or every 20 times their number if that is more",
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
