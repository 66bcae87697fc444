"""The options of the three topics, each once: name, default, effect, origin of the default."""

import argparse
import os

from arguments.param_group import Option, ParamGroup, above, at_least, one_of, within
from utils.system_utils import UserError


def _resolution(value: int) -> str | None:
    return None if value == -1 or value > 0 else "-1, 1, 2, 4, 8 or a width in pixels"


def _tolerance(value: float) -> str | None:
    return None if value == -1 or value >= 0 else "at least 0, or -1"


class ModelParams(ParamGroup):
    """What is trained from what: data, output folder, SH degree. The `stored` ones make up `cfg_args`."""

    title = "model"
    options = (
        Option(
            "sh_degree",
            3,
            "largest degree of the spherical harmonics that make colour depend on the view, 0 to 3; higher: more "
            "view-dependent detail, more memory",
            "paper",
            check=within(0, 3),
            stored=True,
        ),
        Option("source_path", "", "scene folder (COLMAP or Blender)", "none, must be given", short="s", stored=True),
        Option(
            "model_path",
            "",
            "output folder; empty: a new one under ./output, named by OAR_JOB_ID or at random",
            short="m",
            stored=True,
        ),
        Option(
            "images", "images", "folder of the pictures under the scene folder (COLMAP only)", short="i", stored=True
        ),
        Option(
            "depths",
            "",
            "folder of inverse depth maps (PNG by the pictures' names) under the scene folder, which steady what few "
            "pictures see; empty: no depth supervision",
            short="d",
            stored=True,
        ),
        Option(
            "resolution",
            -1,
            "1, 2, 4, 8: divide the size of the pictures by that; -1: as they are, at most 1600 pixels wide; any other "
            "value: width in pixels",
            short="r",
            check=_resolution,
            stored=True,
        ),
        Option("white_background", False, "white behind the scene instead of black", short="w", stored=True),
        Option(
            "train_test_exp",
            False,
            "train a colour correction of each picture, for pictures of different exposure, also on the left halves of "
            "the test pictures; only right halves are scored and rendered",
            stored=True,
        ),
        Option(
            "data_device",
            "cuda",
            "device that keeps the pictures, as 8-bit values; they are kept in pinned memory of the CPU instead, and "
            "copied ahead of their use, where they would take more than a quarter of the GPU's free memory, and with "
            "cpu; without a usable GPU this means the CPU",
            stored=True,
        ),
        Option("eval", False, "hold out a test set: every 8th picture by name, or Blender's test frames", stored=True),
        Option(
            "init_pcd_path",
            "",
            "file of points to start from instead of the scene's own: PLY, npz (points, colors), or text with x y z, "
            "or x y z red green blue, a line",
            "ours",
        ),
        Option(
            "init_type",
            "sfm",
            "points to start from without --init_pcd_path. sfm: the scene's own; random: grey ones in the cameras' "
            "frusta, in Blender scenes in the reference's cube",
            "ours",
            check=one_of("sfm", "random"),
        ),
        Option(
            "masks",
            "",
            "folder of masks in the scene folder, or a whole path: by the names of the pictures, with .png appended or "
            "another suffix, black masks; empty: those that a nerfstudio scene names",
            "ours",
            remembered=True,
        ),
        Option("invert_masks", False, "white masks instead of black", "ours", remembered=True),
        Option(
            "mask_meaning",
            "auto",
            "what is masked by mask files or the pictures' alpha. ignore: left out of loss and scores; transparent: "
            "shows the background; auto: ignore for mask files, transparent for alpha",
            "ours",
            check=one_of("auto", "ignore", "transparent"),
            remembered=True,
        ),
        Option(
            "images_to_load",
            0,
            "decoded pictures kept in memory at most, 0: all; every picture still trains, as it would with all, and "
            "up to 32 that come next are decoded ahead",
            "ours",
            check=at_least(0),
        ),
    )

    def extract(self, args: argparse.Namespace) -> argparse.Namespace:
        """As ParamGroup.extract; a given source_path is made absolute. UserError for options at odds."""
        values = super().extract(args)
        if values.init_pcd_path and values.init_type == "random":
            raise UserError(
                f"--init_type random and --init_pcd_path {values.init_pcd_path} both name the points to start from; "
                "leave one out"
            )
        if values.source_path:
            values.source_path = os.path.abspath(values.source_path)
        return values


class PipelineParams(ParamGroup):
    """How an image is computed. Not part of `cfg_args`; antialiasing is remembered in `model.json`."""

    title = "pipeline"
    options = (
        Option("convert_SHs_python", False, "evaluate spherical harmonics in PyTorch; slower, for experiments"),
        Option("compute_cov3D_python", False, "compute 3D covariances in PyTorch; slower, for experiments"),
        Option("debug", False, "check what goes into and comes out of every kernel; slower"),
        Option("antialiasing", False, "keep a splat's weight when it is smaller than a pixel; for changing distances"),
    )


class OptimizationParams(ParamGroup):
    """How long and how fast is trained, and how the number of Gaussians changes."""

    title = "optimisation"
    options = (
        Option("iterations", 30_000, "training steps, one picture each", "paper", check=within(1, 2**31 - 1)),
        Option(
            "position_lr_init",
            0.00016,
            "learning rate of positions at the start, times the scene extent",
            "paper",
            check=at_least(0),
        ),
        Option(
            "position_lr_final",
            0.0000016,
            "learning rate of positions at position_lr_max_steps, times the scene extent",
            "paper",
            check=at_least(0),
        ),
        Option(
            "position_lr_delay_mult", 0.01, "no effect (no delay steps exist); kept for old commands", check=at_least(0)
        ),
        Option(
            "position_lr_max_steps",
            30_000,
            "step at which the rate of positions reaches its final value; does not follow --iterations",
            check=at_least(1),
        ),
        Option(
            "feature_lr",
            0.0025,
            "learning rate of the base colour; the view-dependent bands get 1/20 of it",
            "paper",
            check=at_least(0),
        ),
        Option(
            "opacity_lr",
            0.025,
            "learning rate of the opacity logits; higher: bolder fading in and out",
            "newest reference; 0.05 in the 2023 release",
            check=at_least(0),
        ),
        Option("scaling_lr", 0.005, "learning rate of the logarithms of the scales", check=at_least(0)),
        Option("rotation_lr", 0.001, "learning rate of the quaternions", check=at_least(0)),
        Option(
            "exposure_lr_init", 0.01, "learning rate of exposures (--train_test_exp) at the start", check=at_least(0)
        ),
        Option("exposure_lr_final", 0.001, "learning rate of exposures in the last step", check=at_least(0)),
        Option(
            "exposure_lr_delay_steps",
            0,
            "steps over which the rate of exposures rises to what it would be without",
            check=at_least(0),
        ),
        Option(
            "exposure_lr_delay_mult",
            0.0,
            "factor of the rate of exposures at step 0 of that rise",
            check=within(0, 1),
        ),
        Option(
            "percent_dense",
            0.01,
            "size, as a fraction of the scene extent, up to which a Gaussian is cloned and above which it is split",
            check=at_least(0),
        ),
        Option(
            "lambda_dssim",
            0.2,
            "weight of 1 - SSIM in the loss; the L1 term gets the rest",
            "paper",
            check=within(0, 1),
        ),
        Option("densification_interval", 100, "steps between densifications", "paper", check=at_least(1)),
        Option(
            "opacity_reset_interval",
            3000,
            "steps between resets of all opacities to at most 0.01",
            "paper",
            check=at_least(1),
        ),
        Option("densify_from_iter", 500, "densification starts after this step", check=at_least(0)),
        Option("densify_until_iter", 15_000, "densification ends before this step", "paper", check=at_least(0)),
        Option(
            "densify_grad_threshold",
            0.0002,
            "screen-space gradient (per NDC unit) that makes a Gaussian clone or split; lower: more Gaussians",
            "paper",
            check=above(0),
        ),
        Option("depth_l1_weight_init", 1.0, "weight of the depth loss (--depths) at the start", check=at_least(0)),
        Option("depth_l1_weight_final", 0.01, "weight of the depth loss in the last step", check=at_least(0)),
        Option(
            "random_background", False, "a new random background in every step, so that nothing hides in one colour"
        ),
        Option(
            "optimizer_type",
            "default",
            "default: Adam over all Gaussians; sparse_adam: steps only those that the view sees, without bias "
            "correction; faster where views see little of the scene",
            check=one_of("default", "sparse_adam"),
        ),
        Option(
            "max_num_splats",
            0,
            "most Gaussians there may be, 0: no limit; at the limit those with the largest gradient are taken",
            "ours",
            check=at_least(0),
        ),
        Option(
            "keep_unseen",
            False,
            "save also the Gaussians that no training view depends on; otherwise the last save leaves them out, which "
            "changes no training view at the size it was trained at, and may change other views and sizes",
            "ours",
        ),
        Option(
            "prune_sh",
            -1.0,
            "cut, in the last save, the SH bands of highest degree that move no colour (0 to 1) by more than this; 0: "
            "those that are zero, -1: none; --sh_degree in cfg_args follows",
            "ours",
            check=_tolerance,
        ),
        Option(
            "seed",
            0,
            "seed of every random choice; same seed, same bytes",
            "ours, and the reference's fixed seed",
            check=within(0, 2**63 - 1),
        ),
    )
