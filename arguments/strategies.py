"""Options of the strategies: how many Gaussians there are, and where, and how a run is paced."""

from arguments.param_group import Option, above, one_of

ADC_OPTIONS: tuple[Option, ...] = (
    Option(
        "absgrad",
        False,
        "densify by the sum of the pixels' absolute gradients (AbsGS), which do not cancel out where a large Gaussian "
        "covers fine detail; absgrad_threshold then stands for densify_grad_threshold",
        "ours",
    ),
    Option(
        "absgrad_threshold",
        0.0008,
        "absolute screen-space gradient (per NDC unit) that makes a Gaussian clone or split, with --absgrad; lower: "
        "more Gaussians",
        "ours, as gsplat recommends",
        check=above(0),
    ),
    Option(
        "split",
        "sample",
        "where the two children of a split Gaussian are. sample: at random, as by its density, each 1.6 times smaller; "
        "long_axis: on both sides along its longest axis, which keeps its mean and covariance",
        "ours",
        check=one_of("sample", "long_axis"),
    ),
)

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
