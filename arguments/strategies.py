"""Options of the strategies: how many Gaussians there are, and where, and how a run is paced."""

from arguments.param_group import Option, above, at_least, one_of, within

ADC_OPTIONS: tuple[Option, ...] = ()

MCMC_OPTIONS: tuple[Option, ...] = ()

BUDGET_OPTIONS: tuple[Option, ...] = (
    Option(
        "growth_power",
        1.0,
        "budget: how early the Gaussians multiply. The part of the densifications that is left, to this power, is the "
        "part of the growth to --max_num_splats that is left; 1: evenly, higher: earlier",
        "ours; 2 in Taming 3DGS",
        check=above(0),
    ),
    Option(
        "score_views",
        10,
        "budget: training views, drawn anew in each densification, whose error says where Gaussians are added",
        "ours",
        check=at_least(1),
    ),
    Option(
        "score_error",
        "l1",
        "budget: error of a pixel. l1: mean absolute difference of the channels; squared: mean squared difference; "
        "loss: that of the loss, L1 and SSIM",
        "ours",
        check=one_of("l1", "squared", "loss"),
    ),
    Option(
        "score_join",
        "sum",
        "budget: how scores of several views become one. sum, or max: the largest",
        "ours",
        check=one_of("sum", "max"),
    ),
    Option(
        "score_power",
        1.0,
        "budget: Gaussians are drawn for splitting with a chance that grows as their score to this power; higher: only "
        "the worst, 0: any that draws an error",
        "ours",
        check=at_least(0),
    ),
    Option(
        "opacity_decay",
        0.98,
        "budget: factor of all opacities after each densification, so that useless Gaussians fade; 1: none",
        "ours",
        check=within(0.5, 1),
    ),
    Option(
        "prune_opacity",
        0.005,
        "budget: Gaussians of a lower opacity are removed, every densification_interval steps",
        "ours, and adaptive density control's",
        check=within(0, 0.5),
    ),
)

PACE_OPTIONS: tuple[Option, ...] = ()

_STRATEGY = Option(
    "strategy",
    "adc",
    "how many Gaussians there are, and where. adc: adaptive density control, the method's own; budget: growth to "
    "--max_num_splats Gaussians, or one for 20 training pixels (100,000 to 1,000,000), where the error is",
    "ours",
    check=one_of("adc", "budget"),
)

STRATEGY_OPTIONS = (_STRATEGY, *ADC_OPTIONS, *MCMC_OPTIONS, *BUDGET_OPTIONS, *PACE_OPTIONS)
