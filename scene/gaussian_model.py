"""The trained model: raw tensors of N Gaussians, their optimiser, and adaptive density control."""

import argparse
import copy
import os
import sys
from collections.abc import Sequence
from typing import Any

import diff_gaussian_rasterization  # noqa: F401  (its library holds the kernel of the statistics)
import numpy as np
import torch
from simple_knn._C import distCUDA2
from torch import Tensor, nn

from scene.gaussians import density as adc
from scene.gaussians.adam import GaussianAdam, StepGuard
from scene.gaussians.attributes import IN_CHECKPOINT, Rows, attributes
from scene.gaussians.exposure import Exposures, read_exposures
from scene.gaussians.ply import read_ply, row_bytes, write_ply
from scene.gaussians.sparse_adam import SparseGaussianAdam
from scene.half_images import exposure_names
from utils.general_utils import build_scaling_rotation, get_expon_lr_func, strip_symmetric
from utils.graphics_utils import BasicPointCloud
from utils.sh_utils import RGB2SH
from utils.system_utils import UserError, compute_device

_OBSERVE = torch.ops.diff_gaussian_rasterization.observe_

INITIAL_OPACITY = 0.1
MIN_DISTANCE2 = 1e-7  # floor of the squared distance to the neighbours, square world units: duplicates get a size
_OPTIMIZERS = {"default": GaussianAdam, "sparse_adam": SparseGaussianAdam}
LONE_POINT_SCALE = 0.01  # initial scale as a part of the extent where there are too few points to have neighbours
OUTLIER_SCALE = 100.0  # extents: an initial scale above is that of a stray point; real scenes have up to 20 or so
LARGEST_OUTLIER = 0.1  # of the extent: what such a point gets, as large as density control lets a Gaussian be


class GaussianModel:
    """N Gaussians with raw (unactivated) float32 parameters; `get_*` give the activated ones.

    `_xyz` (N,3) world; `_features_dc` (N,1,3), `_features_rest` (N,K,3), K = (D+1)^2 - 1; `_scaling` (N,3) log;
    `_rotation` (N,4) wxyz, any length; `_opacity` (N,1) logit. Statistics since the last densification:
    `xyz_gradient_accum` (N,1), `denom` (N,1), `max_radii2D` (N). `exposures`: of the training pictures, identities
    unless trained. world_offset: where the scene has the origin (scene/readers/world_offset.py), kept in the PLY.
    optimizer_type: "default" or "sparse_adam", whose step takes a mask of the visible Gaussians.
    """

    def __init__(self, sh_degree: int, optimizer_type: str = "default") -> None:
        if optimizer_type not in _OPTIMIZERS:
            raise UserError(f"optimizer_type must be {' or '.join(_OPTIMIZERS)}, got {optimizer_type!r}")
        self.active_sh_degree = 0
        self.max_sh_degree = sh_degree
        self.optimizer_type = optimizer_type
        self.optimizer: GaussianAdam | None = None
        self.percent_dense = 0.0
        self.spatial_lr_scale = 0.0
        self.world_offset = (0.0, 0.0, 0.0)
        self.exposures = Exposures()
        self._attributes = attributes(sh_degree)
        self._set_rows({name: torch.empty(0, *attribute.shape) for name, attribute in self._attributes.items()})

    def __len__(self) -> int:
        """Number of Gaussians."""
        return self._xyz.shape[0]

    @property
    def get_xyz(self) -> Tensor:
        return self._xyz

    @property
    def get_features_dc(self) -> Tensor:
        return self._features_dc

    @property
    def get_features_rest(self) -> Tensor:
        return self._features_rest

    @property
    def get_features(self) -> Tensor:
        """All SH coefficients, (N, (D+1)^2, 3)."""
        return torch.cat((self._features_dc, self._features_rest), dim=1)

    @property
    def get_scaling(self) -> Tensor:
        return torch.exp(self._scaling)

    @property
    def get_rotation(self) -> Tensor:
        return nn.functional.normalize(self._rotation)

    @property
    def get_opacity(self) -> Tensor:
        return torch.sigmoid(self._opacity)

    def get_covariance(self, scaling_modifier: float = 1.0) -> Tensor:
        """World covariances R S S R^T, S = modifier * scales: (N, 6), order xx xy xz yy yz zz."""
        factor = build_scaling_rotation(scaling_modifier * self.get_scaling, self._rotation)
        return strip_symmetric(factor @ factor.transpose(1, 2))

    @property
    def get_exposure(self) -> Tensor:
        """Maps of colours (n, 3, 4) of the n training pictures."""
        return self.exposures.values

    def get_exposure_from_name(self, image_name: str) -> Tensor:
        """Map of colours (3, 4) of a training picture, by its name in exposure.json."""
        return self.exposures[image_name]

    @property
    def active_bands(self) -> int:
        """Number of SH coefficients above band 0 that the active degree uses."""
        return (self.active_sh_degree + 1) ** 2 - 1

    # Where Gaussians come from

    def create_from_pcd(self, pcd: BasicPointCloud, cam_infos: Sequence, spatial_lr_scale: float) -> None:
        """Start from a point cloud: round Gaussians as wide as the distance to their neighbours, opacity 0.1.

        spatial_lr_scale: extent of the scene in world units; scales position learning rates and size limits.
        cam_infos: the training cameras, each of which gets an exposure.
        """
        points = np.asarray(pcd.points, dtype=np.float32)
        count = len(points)
        if count == 0:
            raise UserError("the point cloud has no points to start from; give one with --init_pcd_path")
        if not np.isfinite(points).all():
            raise UserError(
                "the point cloud has points that are not finite; remove them, or give another by --init_pcd_path"
            )
        if count < 4:
            scale = np.full(count, LONE_POINT_SCALE * max(spatial_lr_scale, 1e-3), dtype=np.float32)
        else:
            scale = np.sqrt(np.maximum(distCUDA2(torch.from_numpy(points)).numpy(), np.float32(MIN_DISTANCE2)))
            scale = _without_outliers(scale, spatial_lr_scale)
        # NumPy's log: one thread, so the same bits for any number of torch's threads.
        log_scale = torch.from_numpy(np.log(scale))
        colors = torch.from_numpy(np.asarray(pcd.colors, dtype=np.float32))
        self.spatial_lr_scale = float(spatial_lr_scale)
        self.active_sh_degree = 0
        self._set_rows(
            {
                "xyz": torch.from_numpy(points.copy()),
                "f_dc": RGB2SH(colors).reshape(count, 1, 3),
                "f_rest": torch.zeros(count, *self._attributes["f_rest"].shape),
                "opacity": torch.full((count, 1), adc.logit(INITIAL_OPACITY)),
                "scaling": log_scale[:, None].repeat(1, 3),
                "rotation": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
            }
        )
        self.start_exposures(cam_infos)
        print(f"Number of points at initialisation :  {count}")

    def start_exposures(self, cam_infos: Sequence) -> None:
        """Give each training camera an exposure that changes nothing."""
        self.exposures = Exposures(exposure_names(cam_infos))

    def load_ply(self, path: str | os.PathLike) -> None:
        """Take all parameters from a PLY of this model's SH degree (else UserError); all SH bands become active."""
        self._set_rows(read_ply(path, self.max_sh_degree))
        self.active_sh_degree = self.max_sh_degree

    def save_ply(self, path: str | os.PathLike) -> None:
        """Write the raw parameters as a PLY in the reference's layout."""
        write_ply(path, self._rows(), self.max_sh_degree, self.world_offset)

    def load_exposures(self, folder: str | os.PathLike, cam_infos: Sequence) -> None:
        """Take the exposures of the training cameras from a model folder."""
        self.exposures = read_exposures(folder, cam_infos)

    def save_exposures(self, folder: str | os.PathLike) -> None:
        """Write the exposures into a model folder."""
        self.exposures.write(folder)

    @property
    def ply_bytes(self) -> int:
        """Size of the PLY without its header."""
        return len(self) * row_bytes(self.max_sh_degree)

    def part(self, keep: Tensor | slice, sh_degree: int) -> "GaussianModel":
        """A copy of the Gaussians `keep`, (N,) bool or a slice, with the SH bands up to sh_degree and no optimiser."""
        rows = {name: values[keep] for name, values in self._rows().items()}
        rows["f_rest"] = rows["f_rest"][:, : (sh_degree + 1) ** 2 - 1].contiguous()
        other = copy.copy(self)
        other.optimizer = None
        other.max_sh_degree, other.active_sh_degree = sh_degree, min(sh_degree, self.active_sh_degree)
        other._attributes = attributes(sh_degree)
        other._set_rows(rows)
        return other

    def _rows(self) -> Rows:
        return {name: getattr(self, attribute.field).detach() for name, attribute in self._attributes.items()}

    def _set_rows(self, rows: Rows) -> None:
        device = compute_device()
        self._take({name: nn.Parameter(rows[name].to(device)) for name in self._attributes})
        self._zero_statistics()

    def _take(self, params: dict[str, nn.Parameter]) -> None:
        for name, param in params.items():
            setattr(self, self._attributes[name].field, param)

    def _zero_statistics(self) -> None:
        self.xyz_gradient_accum = torch.zeros(len(self), 1, device=self._xyz.device)
        self.denom = torch.zeros(len(self), 1, device=self._xyz.device)
        self.max_radii2D = torch.zeros(len(self), device=self._xyz.device)

    # Optimiser

    def training_setup(self, training_args: argparse.Namespace) -> None:
        """Make the optimiser and the position schedule from the optimisation options; zero the statistics."""
        self.percent_dense = training_args.percent_dense
        self._zero_statistics()
        self.optimizer = _OPTIMIZERS[self.optimizer_type](
            [
                {"params": [getattr(self, a.field)], "lr": a.rate(training_args, self.spatial_lr_scale), "name": name}
                for name, a in self._attributes.items()
            ]
        )
        self.xyz_scheduler_args = get_expon_lr_func(
            lr_init=training_args.position_lr_init * self.spatial_lr_scale,
            lr_final=training_args.position_lr_final * self.spatial_lr_scale,
            lr_delay_mult=training_args.position_lr_delay_mult,
            max_steps=training_args.position_lr_max_steps,
        )
        self._limit_columns()
        self.exposures.training_setup(training_args)

    def update_learning_rate(self, iteration: int) -> float:
        """Set the learning rates of this iteration that change with it; return the positions'."""
        self.exposures.update_learning_rate(iteration)
        rate = self.xyz_scheduler_args(iteration)
        self.optimizer.param_groups[0]["lr"] = rate
        return rate

    def step(self, radii: Tensor) -> None:
        """One step of all optimisers, and no gradients left.

        radii: (N,) pixels in the view of this iteration, 0 for those that the sparse optimiser leaves alone.
        """
        if self.optimizer_type == "sparse_adam":
            self.optimizer.step(radii > 0)
        else:
            self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        self.exposures.step()

    def guard_steps(self, guard: StepGuard) -> None:
        """Let a guard hold back the steps of all optimisers there are now."""
        self.optimizer.guard = self.exposures.optimizer.guard = guard

    def check_steps(self) -> None:
        """UserError where a guard has held steps back, so that the model is not what it is counted as."""
        if self.optimizer.guard and (iteration := self.optimizer.guard.stopped_in()):
            raise UserError(f"loss or step of iteration {iteration} were not finite; lower the learning rates")

    def take_marks(self) -> list[tuple[str, list[int] | list[str], int]]:
        """What a guard kept from its step: name of the tensor, rows (of exposures the pictures), number of all rows."""
        marks = [(name, rows.tolist(), len(self)) for name, rows in self.optimizer.take_marks().items()]
        for name, rows in self.exposures.optimizer.take_marks().items():
            marks.append((name, [self.exposures.names[row] for row in rows.tolist()], len(self.exposures.names)))
        return marks

    def rewind(self, steps: int) -> None:
        """Count back the steps that a guard held back."""
        self.optimizer.rewind(steps)
        self.exposures.optimizer.rewind(steps)

    def oneupSHdegree(self) -> None:
        """Raise the active SH degree by one, up to the maximum."""
        self.active_sh_degree = min(self.active_sh_degree + 1, self.max_sh_degree)
        if self.optimizer is not None:
            self._limit_columns()

    def _limit_columns(self) -> None:
        self.optimizer.set_active_columns("f_rest", 3 * self.active_bands)

    def capture(self) -> tuple:
        """Everything a resumed training needs, as tensors and numbers: 12 entries in the reference's order.

        Attributes that the reference does not have follow as further entries, then the exposures if they are trained.
        """
        rows = self._rows()
        return (
            self.active_sh_degree,
            *(rows[name] for name in IN_CHECKPOINT),
            self.max_radii2D,
            self.xyz_gradient_accum,
            self.denom,
            self.optimizer.state_dict(),
            float(self.spatial_lr_scale),
            *(values for name, values in rows.items() if name not in IN_CHECKPOINT),
            *([self.exposures.capture()] if self.exposures.trained else []),
        )

    def restore(self, model_args: Sequence[Any], training_args: argparse.Namespace) -> None:
        """Take the state of `capture()`. Learning rates and densification options come from `training_args`.

        UserError when the state was made with another maximal SH degree or does not fit together.
        """
        active_sh_degree, *tensors = model_args[:7]
        max_radii2D, xyz_gradient_accum, denom, optimizer_state, spatial_lr_scale, *others = model_args[7:]
        exposures = next((entry for entry in others if isinstance(entry, dict)), None)
        names = (*IN_CHECKPOINT, *(name for name in self._attributes if name not in IN_CHECKPOINT))
        tensors += [entry for entry in others if not isinstance(entry, dict)]
        if len(tensors) != len(names):
            raise UserError(
                f"the checkpoint has {len(tensors)} attributes per Gaussian, where this model has {len(names)} "
                f"({', '.join(names)}); give a checkpoint of this model"
            )
        rows = {name: tensor.detach() for name, tensor in zip(names, tensors, strict=True)}
        self._check_rows(rows)
        if not 0 <= active_sh_degree <= self.max_sh_degree:
            raise UserError(
                f"the active SH degree of the checkpoint is {active_sh_degree}, more than --sh_degree "
                f"{self.max_sh_degree}; give the --sh_degree it was trained with"
            )
        self.active_sh_degree = int(active_sh_degree)
        self.spatial_lr_scale = float(spatial_lr_scale)
        self._set_rows(rows)
        self.training_setup(training_args)
        try:
            self.optimizer.take_state(optimizer_state)
        except ValueError as error:
            raise UserError(f"the optimiser state of the checkpoint does not fit ({error}); use another one") from error
        if exposures is not None:
            self.exposures.restore(exposures)
        device = self._xyz.device
        self.max_radii2D = max_radii2D.to(device)
        self.xyz_gradient_accum = xyz_gradient_accum.to(device)
        self.denom = denom.to(device)

    def _check_rows(self, rows: Rows) -> None:
        """UserError for rows of a checkpoint that are not those of this model."""
        for name, values in rows.items():
            shape = self._attributes[name].shape
            found = tuple(values.shape[1:])
            if name == "f_rest" and found[1:] == shape[1:] and found != shape:
                raise UserError(
                    f"the checkpoint has {found[0]} SH coefficients above band 0, where --sh_degree "
                    f"{self.max_sh_degree} needs {shape[0]}; give the --sh_degree it was trained with"
                )
            if found != shape or values.dtype != torch.float32:
                raise UserError(
                    f"{name} of the checkpoint has the shape {found} and type {values.dtype} per Gaussian, not {shape} "
                    "and float32; give a checkpoint of this model"
                )
        check_finite(rows, "the checkpoint", "give another one")

    def check_finite(self, iteration: int) -> None:
        """UserError where a parameter is not finite, to be called before anything of this iteration is saved."""
        remedy = "nothing of it was saved; lower the learning rates, or go on from an earlier checkpoint"
        check_finite(self._rows(), f"iteration {iteration}", remedy)
        self.exposures.check_finite(f"iteration {iteration}", remedy)

    def take_from_optimizer(self) -> None:
        """After a densification that memory did not suffice for: take the rows that it got to, for saving them."""
        self._take({group["name"]: group["params"][0] for group in self.optimizer.param_groups})
        if any(len(values) != len(self) for values in (self.xyz_gradient_accum, self.denom, self.max_radii2D)):
            self._zero_statistics()

    # Adaptive density control

    def observe(self, viewspace_points: Tensor, radii: Tensor) -> None:
        """Add a view to the statistics: largest radius, gradient length and count of the Gaussians that it saw.

        viewspace_points: (N, 3) with `.grad` per NDC unit; radii: (N,) int32 pixels, 0 where not seen. Raises
        max_radii2D and does what add_densification_stats does for radii > 0, in one pass.
        """
        _OBSERVE(self.max_radii2D, self.xyz_gradient_accum, self.denom, radii, viewspace_points.grad)

    def add_densification_stats(self, viewspace_point_tensor: Tensor, update_filter: Tensor) -> None:
        """Add this view's screen-space gradient lengths and count it, for the Gaussians it saw.

        viewspace_point_tensor: (N, 3) with `.grad` per NDC unit; update_filter: indices (n,) or (n, 1), or a mask (N,).
        """
        x, y = viewspace_point_tensor.grad[:, 0], viewspace_point_tensor.grad[:, 1]
        length = (x * x + y * y).sqrt()[:, None]
        if update_filter.dtype != torch.bool:
            seen = torch.zeros(len(self), dtype=torch.bool, device=length.device)
            update_filter = seen.index_fill_(0, update_filter.reshape(-1), True)
        seen = update_filter[:, None]
        self.xyz_gradient_accum += torch.where(seen, length, 0.0)
        self.denom += seen

    def drop_broken_statistics(self) -> None:
        """Let Gaussians whose gradients' sum is not finite begin it anew."""
        broken = ~self.xyz_gradient_accum.isfinite()
        self.xyz_gradient_accum[broken] = 0.0
        self.denom[broken] = 0.0

    def densify_and_prune(
        self,
        max_grad: float,
        min_opacity: float,
        extent: float,
        max_screen_size: int | None,
        *,
        seed: int = 0,
        iteration: int = 0,
        max_splats: int = 0,
    ) -> None:
        """Clone small and split large Gaussians with a mean gradient >= max_grad, then remove useless ones.

        extent: of the scene, world units; max_screen_size: None, or remove wider ones (pixels) and those over a tenth
        of the extent. seed and iteration decide the positions of split children; max_splats > 0 bounds growth.
        """
        self.optimizer.zero_grad(set_to_none=True)  # its memory is needed; new parameters have none anyway
        gradient = adc.mean_gradient(self.xyz_gradient_accum, self.denom)
        if max_splats > 0:
            gradient = adc.limit_growth(gradient, max_grad, max_splats - len(self))
        self.densify_and_clone(gradient, max_grad, extent)
        self.densify_and_split(gradient, max_grad, extent, seed=seed, iteration=iteration)
        remove = adc.is_useless(self._opacity, min_opacity)
        if max_screen_size:
            # Appending has just zeroed max_radii2D, so the first test never fires, as in the reference.
            remove |= self.max_radii2D > max_screen_size
            remove |= ~adc.is_small(self._scaling, adc.PRUNE_EXTENT * extent)
        self.prune_points(remove)

    def densify_and_clone(self, grads: Tensor, grad_threshold: float, scene_extent: float) -> None:
        """Append an exact copy of each Gaussian with gradient >= threshold and scale <= percent_dense * extent."""
        small = adc.is_small(self._scaling, self.percent_dense * scene_extent)
        chosen = ((grads.reshape(-1) >= grad_threshold) & small).nonzero().reshape(-1)
        self.densification_postfix(*(values.index_select(0, chosen) for values in self._rows().values()))

    def densify_and_split(
        self,
        grads: Tensor,
        grad_threshold: float,
        scene_extent: float,
        N: int = 2,
        *,
        seed: int = 0,
        iteration: int = 0,
    ) -> None:
        """Replace each Gaussian with gradient >= threshold and scale > percent_dense * extent by N smaller ones.

        grads: (n,) or (n, 1) for the first n Gaussians; those appended since (fresh clones) have gradient 0.
        """
        before = len(self)
        large = ~adc.is_small(self._scaling, self.percent_dense * scene_extent)
        grads = grads.reshape(-1)
        large[len(grads) :] = False
        large[: len(grads)] &= grads >= grad_threshold
        parents = large.nonzero().reshape(-1)
        rows = {name: values.index_select(0, parents) for name, values in self._rows().items()}
        children = [
            adc.split_children(
                rows["xyz"], rows["scaling"], rows["rotation"], parents, child, seed=seed, iteration=iteration
            )
            for child in range(N)
        ]
        rows = {name: torch.cat([values] * N) for name, values in rows.items()}
        rows["xyz"], rows["scaling"] = (torch.cat(parts) for parts in zip(*children, strict=True))
        self.densification_postfix(*rows.values())
        self.prune_points(torch.cat((large, large.new_zeros(len(self) - before))))

    def densification_postfix(
        self,
        new_xyz: Tensor,
        new_features_dc: Tensor,
        new_features_rest: Tensor,
        new_opacities: Tensor,
        new_scaling: Tensor,
        new_rotation: Tensor,
        *new_others: Tensor,
    ) -> None:
        """Append Gaussians (raw parameters), also when there are none; the statistics of all are zeroed."""
        new = (new_xyz, new_features_dc, new_features_rest, new_opacities, new_scaling, new_rotation, *new_others)
        self._take(self.optimizer.append_rows(dict(zip(self._attributes, new, strict=True))))
        self._zero_statistics()

    def prune_points(self, mask: Tensor) -> None:
        """Remove the Gaussians of a mask (N,) bool, with their optimiser state and statistics."""
        keep = (~mask).nonzero().reshape(-1)
        if len(keep) == len(self):
            return
        self._take(self.optimizer.keep_rows(keep))
        self.xyz_gradient_accum = self.xyz_gradient_accum.index_select(0, keep)
        self.denom = self.denom.index_select(0, keep)
        self.max_radii2D = self.max_radii2D.index_select(0, keep)

    def reset_opacity(self) -> None:
        """Bring every opacity down to at most 0.01; its Adam moments start again from zero."""
        lowered = self._opacity.detach().clamp_max(adc.logit(adc.RESET_OPACITY))
        self._opacity = self.optimizer.reset("opacity", lowered)


def _without_outliers(scale: np.ndarray, extent: float) -> np.ndarray:
    """Initial scales (N,), where those of points far from all others, which would cover every picture, are lowered."""
    stray = scale > OUTLIER_SCALE * extent
    if extent <= 0 or not stray.any():
        return scale
    print(
        f"{stray.sum()} of {len(scale)} points are more than {OUTLIER_SCALE:g} times the scene's extent from their "
        f"neighbours; their Gaussians begin with a tenth of the extent, {LARGEST_OUTLIER * extent:.3g}",
        file=sys.stderr,
    )
    return np.where(stray, np.float32(LARGEST_OUTLIER * extent), scale)


def check_finite(rows: Rows, where: str, remedy: str) -> None:
    """UserError naming the first attribute with values that are not finite, how many Gaussians, and the first one."""
    for name, values in rows.items():
        # In parts, as there may be little memory left.
        finite = torch.cat([part.isfinite().flatten(1).all(dim=1) for part in values.split(1 << 16)])
        if not finite.all():
            bad = (~finite).nonzero()
            raise UserError(
                f"{name} of {len(bad)} of {len(values)} Gaussians in {where} is not finite "
                f"(the first is Gaussian {int(bad[0])}); {remedy}"
            )
