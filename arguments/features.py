"""The options of features (splatting/features), in the order of the registry, and of observers: a table by name."""

import argparse
from dataclasses import dataclass
from typing import NamedTuple

from arguments.option import CFG_ARGS, MOST_NEEDED, Option, above, at_least, one_of, within
from groundwork.applications import VIEWER_PORT
from groundwork.files.json_files import MODEL_JSON


class Appearance(NamedTuple):
    """A value of --appearance: its name, its summary for the help, and a further option that asks for it."""

    name: str
    summary: str
    flag: str = ""


@dataclass(frozen=True)
class Options:
    """The options of a feature, by the group that they belong to.

    strategy: summary of a value of --strategy, which has the feature's name. appearance: a value of --appearance.
    """

    model: tuple[Option, ...] = ()
    optimisation: tuple[Option, ...] = ()
    launch: tuple[Option, ...] = ()
    strategy: str = ""
    appearance: Appearance | None = None

    @property
    def by_name(self) -> dict[str, Option]:
        """Return all options of the feature by their names."""
        return {option.name: option for option in (*self.model, *self.optimisation, *self.launch)}


class _Port(Option):
    """An option whose value may be left out."""

    def add_to(self, group: argparse._ActionsContainer, sentinel: bool) -> None:
        words = {"type": int, "nargs": "?", "const": VIEWER_PORT, "metavar": "PORT", "help": self.help}
        group.add_argument(f"--{self.name}", **words).topic = self.topic  # type: ignore[arg-type, attr-defined]


def _check_between(value: float) -> str | None:
    return None if 0 < value < 1 else "between 0 and 1, and neither of them"


_PAPER = "ours, from the MCMC paper"
_RELEASED = "ours, from the release of the MCMC paper"

# fmt: off
FEATURES: dict[str, Options] = {
    "time_budget": Options(optimisation=(
        Option("time_budget", 0.0, origin="ours", compared=False, topic=MOST_NEEDED,
            above_zero=True, unset="none", check=within(0, 31_536_000),  # a year
            help="seconds to train, without scores and saves, or more if a finished run is resumed. "
                 "The schedule of --iterations is fitted into them, with 25 to 50 Gaussians for each "
                 "iteration. --strategy auto then means budget, or mcmc for at most 50 photos on a GPU with 0.25 "
                 "s or more for each"),
        Option("schedule", "", origin="ours", compared=False, topic="quality and speed",
            help="schedule.json of a run with --time_budget: repeat its schedule, independent of the clock. Or a "
                 "number: fit the whole schedule of --iterations into this many iterations"),
    )),
    "exposure": Options(
        appearance=Appearance("affine", "--train_test_exp", flag="train_test_exp"),
        model=(
            Option("train_test_exp", False, stored=CFG_ARGS, compared=False, after="white_background",
                topic="photos that vary",
                help="train a colour correction of each photo, for photos of different exposure; the left halves of "
                     "test photos train too, and only their right halves are scored and rendered"),
        ),
        optimisation=(
            Option("exposure_lr_init", 0.01, check=at_least(0), topic="photos that vary",
                help="learning rate of exposures (--train_test_exp) at the start"),
            Option("exposure_lr_final", 0.001, check=at_least(0), topic="photos that vary",
                help="learning rate of exposures in the last step"),
            Option("exposure_lr_delay_steps", 0, check=at_least(0), topic="photos that vary",
                help="steps at the start over which the learning rate of exposures rises to its normal value"),
            Option("exposure_lr_delay_mult", 0.0, check=within(0, 1), topic="photos that vary",
                help="factor of the learning rate of exposures at step 0, where that rise begins"),
        ),
    ),
    "refine_poses": Options(model=(
        Option("refine_poses", False, origin="ours", stored=MODEL_JSON, topic="cameras",
            help="correct the pose of each training camera together with the Gaussians, by at most 3 degrees; needs "
                 "the tracks of a COLMAP scene"),
    )),
    "depths": Options(
        model=(
            Option("depths", "", short="d", stored=CFG_ARGS, seen=False, topic="data",
                help="folder of depth maps inside the scene folder, named like the photos: PNGs of inverse depth, or "
                     "metric PNGs, .npy or .pfm; they stabilise regions that few photos show"),
        ),
        optimisation=(
            Option("depth_l1_weight_init", 1.0, check=at_least(0), topic="data",
                help="weight of the depth loss (--depths) at the start"),
            Option("depth_l1_weight_final", 0.01, check=at_least(0), topic="data",
                help="weight of the depth loss in the last step"),
        ),
    ),
    "curve": Options(launch=(
        Option("no_curve", False, origin="ours", topic="output",
            help="do not write error_vs_time.csv and .png; with --eval they cost up to 5 % of the time, more in short "
                 "runs"),
    )),
    "robust_mask": Options(optimisation=(
        Option("robust_mask", 0.0, origin="ours", check=within(0, 0.5), topic="photos that vary",
            help="largest part of a photo that training may ignore because the other photos do not show it, as with "
                 "passers-by; 0: off"),
    )),
    "adc": Options(strategy="adaptive density control of the 3DGS paper", optimisation=(
        Option("absgrad", False, origin="ours",
            help="adc: densify by absolute gradients of the pixels (AbsGS), which do not cancel out where a large "
                 "Gaussian covers fine detail; --absgrad_threshold then replaces --densify_grad_threshold"),
        Option("absgrad_threshold", 0.0008, origin="ours, as gsplat recommends", check=above(0),
            help="adc: absolute screen-space gradient (per NDC unit) that makes a Gaussian clone or split, with "
                 "--absgrad; lower: more Gaussians"),
    )),
    "mcmc": Options(strategy="moves transparent Gaussians to opaque ones and adds noise to positions", optimisation=(
        Option("mcmc_until_iter", 25_000, origin=_RELEASED, check=at_least(0),
            help="mcmc: relocation and growth end before this step; --densify_until_iter has no effect then"),
        Option("mcmc_growth", 0.05, origin=_PAPER, check=within(0, 1),
            help="mcmc: growth in every densification, as a part of the number of Gaussians"),
        Option("mcmc_min_opacity", 0.005, origin=_PAPER, check=_check_between,
            help="mcmc: a Gaussian of this opacity or less is moved to another one"),
        Option("mcmc_noise", 500_000.0, origin=_PAPER, check=within(0, 1e9),
            help="mcmc: factor of the noise that moves Gaussians in every step, times the learning rate of positions"),
        Option("mcmc_opacity_reg", 0.01, origin=_PAPER, check=at_least(0),
            help="mcmc: weight of the mean opacity in the loss; higher: more Gaussians fade and are moved"),
        Option("mcmc_scale_reg", 0.01, origin=_PAPER, check=at_least(0),
            help="mcmc: weight of the mean scale (world units) in the loss; higher: smaller Gaussians"),
        Option("mcmc_init_opacity", 0.5, origin=_RELEASED, check=_check_between,
            help="mcmc: opacity of the Gaussians that are made from points"),
        Option("mcmc_init_scale", 0.0, origin=_RELEASED, check=at_least(0),
            help="mcmc: scale of the Gaussians that are made from points, as a part of the distance to their "
                 "neighbours; 0: 0.1, or 1 in a given time"),
    )),
    "budget": Options(strategy=(
        "grows to --max_num_splats Gaussians where the error is largest (0: one for 64 training pixels, 100,000 to "
        "1,000,000)"
    ), optimisation=(
        Option("opacity_decay", 0.98, origin="ours", check=within(0.5, 1),
            help="budget: factor of all opacities after each densification, so that unneeded Gaussians fade; 1: off"),
        Option("prune_opacity", 0.005, origin="ours, and adaptive density control's", check=within(0, 0.5),
            help="budget: remove Gaussians of a lower opacity, every --densification_interval steps"),
    )),
    "sky": Options(optimisation=(
        Option("sky", "off", origin="ours", check=one_of("off", "auto"), topic="quality and speed",
            help="auto: add Gaussians on a far sphere in directions that photos show and that have no points; "
                 "off: add none. Trains in one process, with --strategy adc or budget"),
    )),
    "sparse_depth": Options(optimisation=(
        Option("sparse_depth", 0.0, origin="ours", check=at_least(0), topic="data",
            help="weight of the loss of depth at the scene's own points (COLMAP only); 0: off"),
    )),
    "ppisp": Options(appearance=Appearance("ppisp",
        "exposure and white balance of each photo, vignetting and response of each camera, with the test photos held "
        "out, and without resets of opacities at their usual interval")),
    "spill": Options(optimisation=(
        Option("gpu_memory", 0.0, origin="ours", check=within(0, 1_000_000), topic="memory",
            help="GiB of the GPU's memory that training may use, 0: all. SH bands above 0 and their Adam state that do "
                 "not fit are kept in the host's memory; slower, with the same result"),
    )),
    "resume": Options(launch=(
        Option("resume", False, origin="ours", topic=MOST_NEEDED,
            help="resume in -m, or start there, and write checkpoints for the next --resume"),
        Option("no_last_checkpoint", False, origin="ours", called=True, topic="output",
            help="leave no checkpoint at the end. It has 720 MB for a million Gaussians, and --resume continues it "
                 "with more --iterations or seconds"),
    )),
    "remote_viewer": Options(launch=(
        Option("ip", "127.0.0.1", help="address to listen at for the remote viewer", topic="viewers"),
        Option("port", 6009, help="port for the remote viewer, 0: any free one", topic="viewers"),
        Option("disable_viewer", False, called=True, help="open no port for the remote viewer", topic="viewers"),
    )),
    "viewer": Options(launch=(
        _Port("viewer", None, origin="ours", topic=MOST_NEEDED,
            help=f"serve a web page that shows and controls the training, at this port or {VIEWER_PORT}; it stays open "
                 "afterwards (default: no page)"),
        Option("paused", False, origin="ours", topic="viewers",
            help="with --viewer: wait after the first iteration until the page lets the training go on"),
    )),
}
# fmt: on


def options_of(group: str) -> list[Option]:
    """Return the features' options of a group: model, optimisation or launch."""
    return [option for options in FEATURES.values() for option in getattr(options, group)]


def strategies() -> dict[str, str]:
    """Return the summaries of the strategies of density control by their names; the first is the default."""
    return {name: options.strategy for name, options in FEATURES.items() if options.strategy}


def appearances() -> list[Appearance]:
    """Return the ways to train how photos show renders."""
    return [options.appearance for options in FEATURES.values() if options.appearance]
