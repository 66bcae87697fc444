"""Options of the strategies: how many Gaussians there are, and where."""

from splatting.files.json_files import MODEL_JSON
from splatting.training.option import Option, above, at_least, one_of, within

_PAPER = "ours, from the MCMC paper"
_RELEASED = "ours, from the release of the MCMC paper"


STRATEGIES = ("adc", "mcmc", "budget")


def _between(value: float) -> str | None:
    return None if 0 < value < 1 else "between 0 and 1, and neither of them"


# fmt: off
STRATEGY_OPTIONS: tuple[Option, ...] = (
    Option("strategy", "auto", origin="ours", check=one_of("auto", *STRATEGIES), stored=MODEL_JSON,
        help="how many Gaussians there are, and where. auto: adc, or what is best in the time that is given; "
             "a resumed run keeps its own. adc: adaptive density "
             "control, the method's own; mcmc: Gaussians that nobody sees are moved to others, and positions get "
             "noise; budget: growth to --max_num_splats Gaussians, where the error is; 0: one for 64 training pixels, "
             "100,000 to 1,000,000. budget has larger learning rates of colour, opacity, scale and rotation, the fewer "
             "--iterations there are"),

    Option("absgrad", False, origin="ours",
        help="adc: densify by the sum of the pixels' absolute gradients (AbsGS), which do not cancel out where a "
             "large Gaussian covers fine detail; absgrad_threshold then stands for densify_grad_threshold"),
    Option("absgrad_threshold", 0.0008, origin="ours, as gsplat recommends", check=above(0),
        help="adc: absolute screen-space gradient (per NDC unit) that makes a Gaussian clone or split, with "
             "--absgrad; lower: more Gaussians"),
    Option("split", "sample", origin="ours", check=one_of("sample", "long_axis"),
        help="adc: where the two children of a split Gaussian are. sample: at random, as by its density, each 1.6 "
             "times smaller; long_axis: on both sides along its longest axis, which keeps its mean and covariance"),

    Option("mcmc_until_iter", 25_000, origin=_RELEASED, check=at_least(0),
        help="mcmc: relocation and growth end before this step; --densify_until_iter has no effect then"),
    Option("mcmc_growth", 0.05, origin=_PAPER, check=within(0, 1),
        help="mcmc: growth in every densification, as a part of the number of Gaussians"),
    Option("mcmc_min_opacity", 0.005, origin=_PAPER, check=_between,
        help="mcmc: a Gaussian of this opacity or less is moved to another one"),
    Option("mcmc_noise", 500_000.0, origin=_PAPER, check=within(0, 1e9),
        help="mcmc: factor of the noise that moves Gaussians in every step, times the learning rate of positions"),
    Option("mcmc_opacity_reg", 0.01, origin=_PAPER, check=at_least(0),
        help="mcmc: weight of the mean opacity in the loss; higher: more Gaussians fade and are moved"),
    Option("mcmc_scale_reg", 0.01, origin=_PAPER, check=at_least(0),
        help="mcmc: weight of the mean scale (world units) in the loss; higher: smaller Gaussians"),
    Option("mcmc_init_opacity", 0.5, origin=_RELEASED, check=_between,
        help="mcmc: opacity of the Gaussians that are made from points"),
    Option("mcmc_init_scale", 0.0, origin=_RELEASED, check=at_least(0),
        help="mcmc: scale of the Gaussians that are made from points, as a part of the distance to their neighbours; "
             "0: 0.1, or 1 in a given time"),

    Option("opacity_decay", 0.98, origin="ours", check=within(0.5, 1),
        help="budget: factor of all opacities after each densification, so that useless Gaussians fade; 1: none"),
    Option("prune_opacity", 0.005, origin="ours, and adaptive density control's", check=within(0, 0.5),
        help="budget: Gaussians of a lower opacity are removed, every densification_interval steps"),
)
# fmt: on
