"""The trained model: Gaussians with their start, optimiser, exposures and checkpoints."""

import argparse
import os
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from groundwork.host.machine import compute_device
from scene.gaussians import adc, checkpoint, penalty
from scene.gaussians.adam import GaussianAdam, SparseGaussianAdam, StepGuard
from scene.gaussians.attributes import INITIAL_OPACITY
from scene.gaussians.exposure import Exposures, read_exposures, read_pretrained
from scene.gaussians.finite import check_finite
from scene.gaussians.parameters import GaussianParameters, raw_rows
from scene.gaussians.reference_names import ReferenceNames
from scene.gaussians.start import start_rows
from scene.gaussians.table import trainable
from scene.readers.info import photo_names
from utils.general_utils import get_expon_lr_func, inverse_sigmoid
from utils.graphics_utils import BasicPointCloud
from utils.system_utils import UserError

_OPTIMIZERS = {"default": GaussianAdam, "sparse_adam": SparseGaussianAdam}


class GaussianModel(ReferenceNames, GaussianParameters):
    """The Gaussians of a training. ReferenceNames has further names of the reference.

    GaussianParameters has the tensors and their activated forms. optimizer_type: "default" or "sparse_adam", whose step
    takes a mask of the visible Gaussians. spatial_lr_scale: extent of the scene, world units. percent_dense: largest
    scale, as a part of the scene's extent, of a Gaussian that is cloned; a larger one is split.
    """

    optimizer_type = "default"
    spatial_lr_scale = 0.0
    percent_dense = 0.0

    def __init__(self, sh_degree: int, optimizer_type: str = "default") -> None:
        if optimizer_type not in _OPTIMIZERS:
            raise UserError(f"optimizer_type must be {' or '.join(_OPTIMIZERS)}, got {optimizer_type!r}")
        super().__init__(sh_degree)
        self.optimizer_type = optimizer_type

    def create_from_pcd(
        self, pcd: BasicPointCloud, cam_infos: Sequence | float = (), spatial_lr_scale: float | None = None
    ) -> None:
        """Start from a point cloud: round Gaussians as wide as the distance to their neighbours, opacity 0.1.

        spatial_lr_scale: extent of the scene in world units; scales position learning rates and size limits. None: not
        known; it must be set before training_setup.
        cam_infos: the training cameras, records with an `image_name`, each of which gets an exposure. As in the 2023
        release, the extent may stand in their place.
        """
        if not hasattr(cam_infos, "__iter__"):
            cam_infos, spatial_lr_scale = (), cam_infos
        rows = start_rows(pcd, float(spatial_lr_scale or 0), self.max_sh_degree, self.enlargement)
        if self.inverse_opacity_activation is not inverse_sigmoid:
            opacity = torch.full_like(rows["opacity"], INITIAL_OPACITY, device=compute_device())
            rows["opacity"] = self.inverse_opacity_activation(opacity)
        self.spatial_lr_scale = None if spatial_lr_scale is None else float(spatial_lr_scale)
        self.active_sh_degree = 0
        self.take_whole(rows)
        self.start_exposures(cam_infos)
        print(f"Number of points at initialisation :  {self.gaussian_count}")

    def load_ply(self, path: str | os.PathLike, use_train_test_exp: bool = False) -> None:
        """Take all parameters from a PLY of this model's SH degree (else UserError); all SH bands become active.

        use_train_test_exp: also read the exposures, from the model folder that has the PLY in
        point_cloud/iteration_N. They are then `pretrained_exposures`.
        """
        super().load_ply(path)
        if use_train_test_exp:
            self.pretrained_exposures = read_pretrained((Path(path).absolute().parent / "../..").resolve())

    # Density control: the reference's (scene/gaussians/adc.py)

    observe, observe_absolute = adc.observe, adc.observe_absolute
    add_densification_stats = adc.add_densification_stats
    densify_and_prune = adc.densify_and_prune
    densify_and_clone, densify_and_split = adc.densify_and_clone, adc.densify_and_split
    densification_postfix, prune_points = adc.densification_postfix, adc.prune_points
    reset_opacity = adc.reset_opacity
    add_penalty_gradients = penalty.add_penalty_gradients

    # Exposures

    @cached_property
    def exposures(self) -> Exposures:
        """Maps of colours of the training photos, identities unless trained."""
        return Exposures()

    def start_exposures(self, cam_infos: Sequence) -> None:
        """Give each training camera an exposure that changes nothing."""
        self.exposures = Exposures(photo_names(cam_infos))

    def load_exposures(self, folder: str | os.PathLike, cam_infos: Sequence) -> None:
        """Take the exposures of the training cameras from a model folder."""
        image_names = [camera.image_name for camera in cam_infos]
        self.exposures = read_exposures(folder, photo_names(cam_infos), image_names)

    def save_exposures(self, folder: str | os.PathLike) -> None:
        """Write the exposures into a model folder."""
        self.exposures.write(folder)

    # Optimiser

    def training_setup(self, training_args: argparse.Namespace) -> None:
        """Make the optimisers and their schedules from the optimisation options; zero the statistics.

        Parameters become contiguous in place. Plain tensors, which code may have assigned, become parameters.
        """
        self.percent_dense = training_args.percent_dense
        self._take({name: trainable(getattr(self, a.field)) for name, a in self._attributes.items()})
        self._zero_statistics()
        self._rates = {n: a.rate(training_args, self.spatial_lr_scale) for n, a in self._attributes.items()}
        groups = [
            {"params": [getattr(self, a.field)], "lr": self._rates[name], "name": name}
            for name, a in self._attributes.items()
        ]
        self.optimizer = _OPTIMIZERS[self.optimizer_type](groups)
        self.xyz_scheduler_args = get_expon_lr_func(
            lr_init=training_args.position_lr_init * self.spatial_lr_scale,
            lr_final=training_args.position_lr_final * self.spatial_lr_scale,
            lr_delay_mult=training_args.position_lr_delay_mult,
            max_steps=training_args.position_lr_max_steps,
        )
        self.exposures.training_setup(training_args)

    def step_sparsely(self) -> None:
        """Step only Gaussians that a view sees from now on, with the same averages. Other code's optimiser stays."""
        old = self.optimizer
        if type(old) is GaussianAdam:
            groups = ({key: group[key] for key in ("params", "lr", "name")} for group in old.param_groups)
            self.optimizer = SparseGaussianAdam([*groups])
            self.optimizer.state.update(old.state)
            self.limit_columns()

    def update_learning_rate(self, iteration: int) -> float:
        """Set the scheduled learning rates for this iteration; return that of the positions."""
        self.exposures.update_learning_rate(iteration)
        rate = self.xyz_scheduler_args(iteration)
        for group in self.optimizer.param_groups:
            if group.get("name") == "xyz":
                group["lr"] = rate
                break
        return rate

    def scale_rates(self, factor: float, bands: float = 1.0) -> None:
        """Multiply the learning rates that `training_setup` has made, except the positions'.

        bands: further factor for SH bands above degree 0.
        """
        for group in self.optimizer.param_groups:
            if group.get("name") in self._rates and group["name"] != "xyz":
                group["lr"] = (factor * bands if group["name"] == "f_rest" else factor) * self._rates[group["name"]]

    @property
    def position_learning_rate(self) -> float:
        """Learning rate of the positions, as `update_learning_rate` has set it."""
        return next(group["lr"] for group in self.optimizer.param_groups if group.get("name") == "xyz")

    def step(self, radii: Tensor) -> None:
        """Step all optimisers and drop the gradients.

        radii: (N,) pixels in the view of this iteration, or (V, N) in its views; the sparse optimiser skips Gaussians
        of radius 0.
        """
        if isinstance(self.optimizer, SparseGaussianAdam):
            self.optimizer.step((radii if radii.dim() == 1 else radii.amax(0)) > 0)
        else:
            self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        self.exposures.step()

    def drop_gradients(self) -> None:
        """Drop the gradients without a step."""
        self.optimizer.zero_grad(set_to_none=True)
        self.exposures.optimizer.zero_grad(set_to_none=True)

    def guard_steps(self, guard: StepGuard) -> None:
        """Let a guard hold back the steps of all optimisers; training_setup makes unguarded ones."""
        self.optimizer.guard = self.exposures.optimizer.guard = guard

    def guard_loss(self, iteration: int, loss: Tensor) -> None:
        """Give the guard, if there is one, the scalar loss of an iteration before its step."""
        if guard := getattr(self.optimizer, "guard", None):
            guard.watch(iteration, loss)

    def rewind(self, steps: int) -> None:
        """Reduce the step counters by steps that were counted and not taken."""
        self.optimizer.rewind(steps)
        self.exposures.optimizer.rewind(steps)

    def drop_held_steps(self, steps: int) -> None:
        """Undo the counts of steps that a guard held back: `steps` in all values, and one in the marked values."""
        self.rewind(steps)
        self.optimizer.drop_marks()
        self.exposures.optimizer.drop_marks()

    def oneupSHdegree(self) -> None:
        """Raise the active SH degree by one, up to the maximum."""
        self.active_sh_degree = min(self.active_sh_degree + 1, self.max_sh_degree)

    def limit_columns(self) -> None:
        """Promise GaussianAdam that the SH bands above the active degree never had a gradient, so that it skips them.

        train.py calls it whenever it has set the degree. Code that may read or raise other bands leaves it out.
        """
        if isinstance(self.optimizer, GaussianAdam):
            self.optimizer.set_active_columns("f_rest", 3 * self.active_sh_bands)

    capture, restore = checkpoint.capture, checkpoint.restore

    def check_finite(self, iteration: int) -> None:
        """UserError for a parameter that is not finite; call it before anything of this iteration is saved."""
        remedy = "nothing of this iteration was saved; lower the learning rates, or resume from an earlier checkpoint"
        check_finite(raw_rows(self), f"iteration {iteration}", remedy, self.shards)
        self.exposures.check_finite(f"iteration {iteration}", remedy)
