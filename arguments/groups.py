"""Tables of options in three groups; each option has a name, default, effect and origin of the default."""

import argparse
import os
from collections.abc import Collection

from arguments.features import appearances, options_of, strategies
from arguments.option import CFG_ARGS, MOST_NEEDED, Option, above, at_least, in_places, one_of, within
from arguments.param_group import GroupParams, OptionTable
from groundwork.files.json_files import MODEL_JSON
from utils.system_utils import UserError


def _check_resolution(value: int) -> str | None:
    return None if value == -1 or value > 0 else "-1, 1, 2, 4, 8 or a width in pixels"


class ModelParams(OptionTable):
    """Options of the data, the output folder and the SH degree. Those of CFG_ARGS make up that file."""

    title = "model"
    # fmt: off
    options = in_places((
        Option("sh_degree", 3, origin="paper", check=within(0, 3), stored=CFG_ARGS, compared=False,
            loaded="that of the saved PLY", topic="quality and speed",
            help="highest degree, 0 to 3, of the spherical harmonics that make colour depend on the view; higher: "
                 "more view-dependent detail, more memory"),
        Option("source_path", "", short="s", stored=CFG_ARGS, topic=MOST_NEEDED, unset="none, must be given",
            help="scene folder: COLMAP, Blender, nerfstudio, or an export of Metashape, Polycam or Record3D"),
        Option("model_path", "", short="m", stored=CFG_ARGS, compared=False, loaded="none, must be given",
            topic=MOST_NEEDED, unset="a new folder under ./output, named after OAR_JOB_ID or the scene",
            help="model folder"),
        Option("images", "images", short="i", stored=CFG_ARGS, topic="data",
            help="folder of the photos inside the scene folder, in place of that which a camera file names"),
        *options_of("model"),
        Option("resolution", -1, short="r", check=_check_resolution, stored=CFG_ARGS, topic=MOST_NEEDED,
            help="1, 2, 4, 8: divide the size of the photos by this; -1: keep their size, but at most 1600 pixels "
                 "wide; other values: width in pixels"),
        Option("white_background", False, short="w", stored=CFG_ARGS, topic="data",
            help="white background instead of black"),
        Option("data_device", "cuda", stored=CFG_ARGS, compared=False, topic="memory",
            help="device that holds the images. With cpu, or if they would take more than a quarter of the GPU's free "
                 "memory, the host's memory holds them, and each is copied to the GPU before it is used. Without a "
                 "usable GPU, cuda means cpu"),
        Option("eval", False, stored=CFG_ARGS, topic=MOST_NEEDED,
            help="hold out photos as --holdout says, or Blender's test frames, to test the model"),
        Option("holdout", "every8", origin="ours", check=one_of("every8", "sector", "block"), stored=MODEL_JSON,
            topic="data",
            help="photos that --eval holds out. every8: every 8th by name; sector: an eighth, side by side around what "
                 "the cameras look at; block: an eighth in succession by name. The last two leave a gap, so scores are "
                 "of views that no photo is close to"),
        Option("init_pcd_path", "", origin="ours", topic="data",
            help="file of points to start from instead of the scene's own: PLY, npz (points, colors), or text with "
                 "x y z or x y z red green blue in each line"),
        Option("init_ply", "", origin="ours", topic="data",
            help="model whose Gaussians training starts from: PLY or compressed PLY of any program, SPZ, .splat, "
                 "or a checkpoint of train.py, gsplat or nerfstudio; a point cloud is read as by --init_pcd_path"),
        Option("init_type", "sfm", origin="ours", check=one_of("sfm", "random"), topic="data",
            help="points to start from without --init_pcd_path and --init_ply. sfm: the scene's own; random: grey "
                 "points in the cameras' frusta, or for Blender scenes in the cube that the cameras look at"),
        Option("masks", "", origin="ours", stored=MODEL_JSON, topic="data",
            help="folder of mask files inside the scene folder, or an absolute path; black is masked. A mask has its "
                 "photo's name, with .png, .mask.png or _mask.png appended or with another suffix. Empty: the masks "
                 "that a nerfstudio scene names"),
        Option("invert_masks", False, "white is masked instead of black", "ours", stored=MODEL_JSON, topic="data"),
        Option("mask_meaning", "auto", origin="ours", check=one_of("auto", "ignore", "transparent", "none"),
            stored=MODEL_JSON, topic="data",
            help="meaning of pixels masked by mask files or by the photos' alpha. ignore: leave them out of loss and "
                 "scores; transparent: they show the background; auto: ignore for mask files, transparent for alpha; "
                 "none: ignore for mask files, and photos are opaque"),
        Option("lenses", "auto", origin="ours", check=one_of("auto", "undistort", "native"), stored=MODEL_JSON,
            topic="cameras",
            help="photos of distorting lenses. native: train on the photos as they are, if the rasterizer knows the "
                 "camera model; undistort: resample them to pinhole images when they are loaded; auto: native; a "
                 "resumed training keeps what it began with, and code that does not use train.py undistorts"),
        Option("appearance", "none", origin="ours", check=one_of("none", *(one.name for one in appearances())),
            stored=MODEL_JSON, topic="photos that vary",
            help="model of exposure, for photos that differ in brightness or colour. "
                 + "; ".join(f"{a.name}: {a.summary}" for a in appearances())
                 + "; exports and viewers do not show it"),
        Option("images_to_load", 0, origin="ours", check=at_least(0), topic="memory",
            help="largest number of decoded images (photos, masks and depth maps) in memory, 0: all. The others are "
                 "read again when they are needed; the result is the same"),
    ))
    # fmt: on

    def __init__(self, parser: argparse.ArgumentParser, sentinel: bool = False, without: Collection[str] = ()) -> None:
        self._add_table(parser, sentinel, without)

    def extract(self, args: argparse.Namespace) -> GroupParams:
        """Return the model options from parsed `args`, with defaults for missing ones and an absolute source_path.

        An --appearance also sets the flag that stands for it. UserError for invalid or contradictory options.
        """
        values = super().extract(args)
        given = {name: getattr(values, name, "") for name in ("init_type", "init_pcd_path", "init_ply")}
        starts = [f"--{name} {value}" for name, value in given.items() if value not in ("", "sfm")]
        if len(starts) > 1:
            raise UserError(f"{' and '.join(starts[:2])} both name the points to start from; leave one out")
        for appearance in filter(lambda one: one.flag, appearances()):
            kind, flag, named = appearance.name, appearance.flag, getattr(values, "appearance", "none")
            if named == kind:
                setattr(values, flag, True)
            elif named != "none" and getattr(values, flag, False):
                raise UserError(f"--{flag} means --appearance {kind}; leave out --{flag} or --appearance {named}")
        if getattr(values, "source_path", ""):
            values.source_path = os.path.abspath(values.source_path)
        return values


class PipelineParams(OptionTable):
    """Options of rendering. None is part of `cfg_args`."""

    title = "pipeline"
    # fmt: off
    options = (
        Option("convert_SHs_python", False, topic="debugging",
            help="evaluate spherical harmonics in PyTorch; slower, for experiments"),
        Option("compute_cov3D_python", False, topic="debugging",
            help="compute 3D covariances in PyTorch; slower, for experiments"),
        Option("debug", False, "check the inputs and outputs of every kernel; slower", topic="debugging"),
        Option("antialiasing", False, stored=MODEL_JSON, topic="quality and speed",
            help="keep the total weight of splats that are smaller than a pixel, so that views from other distances "
                 "look right"),
        Option("projection", "ewa", origin="ours", check=one_of("ewa", "ray"), stored=MODEL_JSON, topic="cameras",
            help="how Gaussians are projected. ewa: to ellipses on the image (Zwicker et al. 2001); ray: evaluated "
                 "on the ray of each pixel, exact for any size and angle; trains in one process only"),
    )
    # fmt: on

    def __init__(self, parser: argparse.ArgumentParser, sentinel: bool = False, without: Collection[str] = ()) -> None:
        self._add_table(parser, sentinel, without)


class OptimizationParams(OptionTable):
    """Options of the optimisation: its length, its learning rates, and the control of the number of Gaussians."""

    title = "optimisation"
    # fmt: off
    options = (
        Option("iterations", 30_000, origin="paper", check=within(1, 2**31 - 1), compared=False, topic=MOST_NEEDED,
            help="training steps, one photo each"),
        Option("position_lr_init", 0.00016, origin="paper", check=at_least(0),
            help="learning rate of positions at the start, times the scene extent"),
        Option("position_lr_final", 0.0000016, origin="paper", check=at_least(0),
            help="learning rate of positions at position_lr_max_steps, times the scene extent. Between both it falls "
                 "evenly in its logarithm; linearly where one is 0, as other rates and weights with two ends do"),
        Option("position_lr_delay_mult", 0.01, check=at_least(0),
            help="no effect, there are no delay steps; kept for old commands"),
        Option("position_lr_max_steps", 30_000, check=at_least(1),
            help="step at which the learning rate of positions reaches its final value; independent of --iterations"),
        Option("feature_lr", 0.0025, origin="paper", check=at_least(0),
            help="learning rate of the base colour; that of the view-dependent bands is 1/20 of it"),
        Option("opacity_lr", 0.025, origin="newest reference; 0.05 in the 2023 release", check=at_least(0),
            help="learning rate of the opacity logits; higher: Gaussians fade in and out faster"),
        Option("scaling_lr", 0.005, "learning rate of the logarithms of the scales", check=at_least(0)),
        Option("rotation_lr", 0.001, "learning rate of the quaternions", check=at_least(0)),
        Option("percent_dense", 0.01, check=at_least(0),
            help="size that decides densification, as a fraction of the scene extent: smaller Gaussians are cloned, "
                 "larger ones split"),
        Option("lambda_dssim", 0.2, origin="paper", check=within(0, 1),
            help="weight of 1 - SSIM in the loss; the weight of the L1 term is 1 minus this"),
        Option("densification_interval", 100, "steps between densifications", "paper", check=at_least(1)),
        Option("opacity_reset_interval", 3000, origin="paper", check=at_least(1),
            help="steps between resets of all opacities to at most 0.01; one with less than half of them to go is left "
                 "out"),
        Option("densify_from_iter", 500, "densification starts after this step", check=at_least(0)),
        Option("densify_until_iter", 15_000, "densification ends before this step", "paper", check=at_least(0)),
        Option("densify_grad_threshold", 0.0002, origin="paper", check=above(0),
            help="screen-space gradient (per NDC unit) that makes a Gaussian clone or split; lower: more Gaussians"),
        *options_of("optimisation"),
        Option("keep_unseen", False, origin="ours", topic="output",
            help="save invisible Gaussians, too. Without this the last save leaves out those that no training view "
                 "and no view between neighbours needs; training views stay the same, views from elsewhere may change"),
        Option("prune_sh", -1.0, origin="ours", topic="output",
            check=lambda value: None if value == -1 or value >= 0 else "at least 0, or -1",
            help="in the last save, drop the highest SH bands that change no colour (0 to 1) by more than this; 0: "
                 "drop bands that are zero throughout, -1: drop none. The sh_degree in cfg_args follows"),
        Option("random_background", False, topic="data",
            help="a new random background in every step, so that no Gaussian imitates a fixed one"),
        Option("optimizer_type", "default", check=one_of("default", "sparse_adam"), stored=MODEL_JSON,
            topic="quality and speed",
            help="default: Adam on all Gaussians; sparse_adam: Adam without bias correction, only on the Gaussians "
                 "that the view sees, which is faster if views see little of the scene; mcmc always takes it"),
        Option("max_num_splats", 0, origin="ours", check=at_least(0), topic=MOST_NEEDED,
            help="largest number of Gaussians; 0: no limit with adc, 1,000,000 with mcmc, and with budget as "
                 "--strategy says. If a training starts with more, only budget removes the surplus"),
        Option("seed", 0, origin="ours, and the reference's fixed seed", check=within(0, 2**63 - 1), stored=MODEL_JSON,
            topic="quality and speed",
            help="seed of every random choice; the same seed gives the same bytes"),
        Option("strategy", "auto", origin="ours", check=one_of("auto", *strategies()), stored=MODEL_JSON,
            topic=MOST_NEEDED,
            help="how Gaussians are added, moved and removed. auto: adc, or the best strategy for a given time; a "
                 "resumed run keeps its own. " + "; ".join(f"{name}: {about}" for name, about in strategies().items())),
    )
    # fmt: on

    def __init__(self, parser: argparse.ArgumentParser, sentinel: bool = False, without: Collection[str] = ()) -> None:
        self._add_table(parser, sentinel, without)


OPTIONS = (*ModelParams.options, *PipelineParams.options, *OptimizationParams.options)
