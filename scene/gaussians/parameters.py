"""A set of Gaussians: raw tensors, their activated forms, statistics, and the PLY they are kept in."""

import copy
import math
import os
from collections.abc import Callable
from operator import attrgetter
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor, nn

from groundwork.host.machine import compute_device
from groundwork.ranks.ranks import Ranks
from groundwork.ranks.rows import WHOLE, Divided, Shards
from scene.gaussians.attributes import Attribute, Rows, attributes
from scene.gaussians.finite import warn_of_undrawn
from scene.gaussians.ply import FLAT, column_names, frame_comments, read_ply, row_bytes, write_ply
from scene.gaussians.spilled import Storage, is_spilled, to_host
from scene.gaussians.statistics import NAMES, Statistics
from scene.gaussians.table import GaussianTable
from utils.general_utils import build_scaling_rotation, inverse_sigmoid, strip_symmetric
from utils.system_utils import UserError


def covariance(scaling: Tensor, scaling_modifier: float, rotation: Tensor) -> Tensor:
    """World covariances R S S R^T, S = modifier * scales (N, 3), R of quaternions (N, 4) wxyz of any length.

    Returns (N, 6), order xx xy xz yy yz zz.
    """
    factor = build_scaling_rotation(scaling_modifier * scaling, rotation)
    return strip_symmetric(factor @ factor.transpose(1, 2))


def raw_rows(gaussians: "GaussianParameters") -> Rows:
    """Raw values by optimiser group, without gradient; they share the parameters' memory.

    A function and no method, so that a subclass with a method `rows` of its own changes nothing.
    """
    return {name: getattr(gaussians, a.field).detach() for name, a in gaussians._attributes.items()}


class GaussianParameters:
    """N Gaussians with raw (unactivated) float32 parameters; `get_*` give the activated ones.

    `_xyz` (N,3) world; `_features_dc` (N,1,3), `_features_rest` (N,K,3), K = (D+1)^2 - 1; `_scaling` (N,3) log;
    `_rotation` (N,4) wxyz, any length; `_opacity` (N,1) logit. world_offset: the world's coordinates of the origin
    (scene/readers/info.py), kept in the PLY, as is enlargement: the factor by which the model and its cameras
    are enlarged where they are drawn (scene/readers/tracks.py). Activations are attributes, which
    `setup_functions` sets.
    The tensors become parameters when rows are taken; an empty model has plain ones, as in the reference. shards: where
    these rows are among those of all ranks, if several have a part of the model each. storage: where rows
    lie, None: on the device.
    fixed: tells which of means (N,3) density control leaves, of any size, (N,) bool; None: it may remove all.
    max_radii2D, xyz_gradient_accum, denom: observations since the last densification (Statistics has shapes and units).
    optimizer: any of torch's, with `name` in its groups; None until training is set up. tmp_radii: (N,) pixels of the
    present view, or None; density control keeps it in step with the rows. columns: further values
    (N, ...) by name that move with the rows, zero in new ones.
    """

    # What a subclass need not set whose __init__ sets the reference's attributes and does not call this one.
    active_sh_degree = 0
    max_sh_degree = 3
    world_offset = (0.0, 0.0, 0.0)
    enlargement = 1.0
    shards: Shards = WHOLE
    storage: Storage | None = None
    fixed: Callable[[Tensor], Tensor] | None = None
    optimizer: torch.optim.Optimizer | None = None
    tmp_radii: Tensor | None = None
    columns: dict[str, Tensor] = MappingProxyType({})

    _xyz: Tensor
    _features_dc: Tensor
    _features_rest: Tensor
    _scaling: Tensor
    _rotation: Tensor
    _opacity: Tensor
    max_radii2D: Tensor
    xyz_gradient_accum: Tensor
    denom: Tensor

    def __init__(self, sh_degree: int) -> None:
        """Make a model without Gaussians, on the computing device, for SH coefficients up to a degree."""
        self.active_sh_degree = 0
        self.max_sh_degree = sh_degree
        self.world_offset = (0.0, 0.0, 0.0)
        device = compute_device()
        self._take({name: torch.empty(0, *a.shape, device=device) for name, a in self._attributes.items()})
        self.setup_functions()
        self._zero_statistics()

    def setup_functions(self) -> None:
        """Set the activations and their inverses: attributes that may be replaced, or set by a subclass here."""
        self.scaling_activation = torch.exp
        self.scaling_inverse_activation = torch.log
        self.covariance_activation = covariance
        self.opacity_activation = torch.sigmoid
        self.inverse_opacity_activation = inverse_sigmoid
        self.rotation_activation = nn.functional.normalize

    @property
    def _attributes(self) -> dict[str, Attribute]:
        """The table of the attributes, for the maximal SH degree."""
        return attributes(self.max_sh_degree)

    @property
    def table(self) -> GaussianTable:
        """All tensors with a row per Gaussian, to add, remove or reorder rows."""
        return GaussianTable(self)

    @property
    def statistics(self) -> Statistics:
        """The observations since the last densification, in one record of the model's own tensors."""
        return Statistics(*_read_statistics(self))

    @statistics.setter
    def statistics(self, statistics: Statistics) -> None:
        for name in NAMES:
            setattr(self, name, getattr(statistics, name))

    def _zero_statistics(self) -> None:
        self.statistics = Statistics.zero(len(self), self._xyz.device)

    def __len__(self) -> int:
        """Number of Gaussians that this process has."""
        return self._xyz.shape[0]

    @property
    def gaussian_count(self) -> int:
        """Number of Gaussians that all ranks have."""
        return self.shards.total(len(self))

    def divide(self, ranks: Ranks) -> None:
        """Let ranks share the Gaussians of a model that has none yet: each keeps its part of what is loaded."""
        if ranks.several:
            self.shards = Divided(ranks, 0)

    def __bool__(self) -> bool:
        """True, also for a model without Gaussians: the reference's has no length."""
        return True

    @property
    def get_xyz(self) -> Tensor:
        """Centres (N, 3), world units."""
        return self._xyz

    @property
    def get_features_dc(self) -> Tensor:
        """SH coefficients of band 0, (N, 1, 3)."""
        return self._features_dc

    @property
    def get_features_rest(self) -> Tensor:
        """SH coefficients above band 0, (N, (D+1)^2 - 1, 3)."""
        return self._features_rest

    @property
    def get_features(self) -> Tensor:
        """All SH coefficients, (N, (D+1)^2, 3)."""
        return torch.cat((self._features_dc, self._features_rest), dim=1)

    @property
    def get_scaling(self) -> Tensor:
        """Standard deviations (N, 3) along the Gaussian's own axes, world units."""
        return self.scaling_activation(self._scaling)

    @property
    def get_rotation(self) -> Tensor:
        """Unit quaternions (N, 4), wxyz."""
        return self.rotation_activation(self._rotation)

    @property
    def get_opacity(self) -> Tensor:
        """Opacities (N, 1) in (0, 1)."""
        return self.opacity_activation(self._opacity)

    def get_covariance(self, scaling_modifier: float = 1.0) -> Tensor:
        """World covariances R S S R^T, S = modifier * scales: (N, 6), order xx xy xz yy yz zz."""
        return self.covariance_activation(self.get_scaling, scaling_modifier, self._rotation)

    def raw_geometry(self) -> dict[str, Tensor]:
        """Raw shapes by the rasterizer's names: opacities (N, 1) logit, scales (N, 3) log, rotations (N, 4) wxyz."""
        if self._scaling.shape[1] == 2:
            raise UserError(f"this model has {FLAT}")
        return {"opacities": self._opacity, "scales": self._scaling, "rotations": self._rotation}

    @property
    def kernels_activate(self) -> bool:
        """True if the rasterizer's kernels activate `raw_geometry()` as this model does.

        False once an activation was replaced, or a getter of opacities, scales or rotations overridden.
        """
        kind = type(self)
        return (
            self.opacity_activation is torch.sigmoid
            and self.scaling_activation is torch.exp
            and self.rotation_activation is nn.functional.normalize
            and (kind.get_opacity, kind.get_scaling, kind.get_rotation) == _GEOMETRY
        )

    @property
    def features_are_raw(self) -> bool:
        """True if the getters of SH coefficients give the raw ones; not if a subclass overrides one of them."""
        kind = type(self)
        return (kind.get_features, kind.get_features_dc, kind.get_features_rest) == _FEATURES

    def raw(self, name: str) -> Tensor:
        """Raw values (N, ...) of an attribute, by its name in the table of scene/gaussians/attributes.py."""
        return getattr(self, self._attributes[name].field)

    def construct_list_of_attributes(self) -> list[str]:
        """Names of the properties of the PLY, in its order."""
        return column_names(self._find_degree(), self._scaling.shape[1])

    def _find_degree(self) -> int:
        """SH degree of the tensors. It is below max_sh_degree once bands were cut. UserError for a part of a band."""
        bands = self._features_rest.shape[1]
        degree = math.isqrt(bands + 1) - 1
        if (degree + 1) ** 2 - 1 != bands:
            raise UserError(
                f"a colour has {bands} SH coefficients above band 0, those of no SH degree; keep 0, 3, 8 or 15 of them"
            )
        return degree

    def log_scales(self) -> Tensor:
        """Logarithms (N, 3) of the scales, whatever their activation is."""
        return (self._scaling if self.kernels_activate else self.get_scaling.log()).detach()

    def opacity_logits(self) -> Tensor:
        """Logits (N, 1) of the opacities, whatever their activation is."""
        return (self._opacity if self.kernels_activate else inverse_sigmoid(self.get_opacity)).detach()

    @property
    def keeps_logits(self) -> bool:
        """True if raw opacities are logits, in both directions."""
        return self.kernels_activate and self.inverse_opacity_activation is inverse_sigmoid

    def raw_opacity(self, logits: Tensor) -> Tensor:
        """Raw values of opacities (n, 1) given by their logits."""
        return logits if self.keeps_logits else self.inverse_opacity_activation(logits.sigmoid())

    def raw_scaling(self, log_scales: Tensor) -> Tensor:
        """Raw values of scales (n, 3) given by their logarithms."""
        keeps = self.kernels_activate and self.scaling_inverse_activation is torch.log
        return log_scales if keeps else self.scaling_inverse_activation(log_scales.exp())

    def raw_shapes(self, logits: Tensor, log_scales: Tensor) -> Rows:
        """Raw opacities and scales by name."""
        return {"opacity": self.raw_opacity(logits), "scaling": self.raw_scaling(log_scales)}

    @property
    def active_sh_bands(self) -> int:
        """Number of SH coefficients above band 0 that the active degree uses."""
        return (self.active_sh_degree + 1) ** 2 - 1

    def load_ply(self, path: str | os.PathLike) -> None:
        """Take all parameters from a PLY of this model's SH degree (else UserError); all SH bands become active.

        Flat Gaussians of two scales are read, too; the rasterizer refuses to draw them.
        """
        rows = read_ply(path, self.max_sh_degree, flat=True)
        warn_of_undrawn(rows, path)
        self.take_whole(rows)
        self.active_sh_degree = self.max_sh_degree

    @property
    def frame(self) -> dict[str, Any]:
        """The entries of model.json on the frame of the coordinates."""
        return {"world_offset": self.world_offset, "enlargement": self.enlargement}

    def save_ply(self, path: str | os.PathLike) -> None:
        """Write the raw parameters as a PLY in the reference's layout."""
        comments = frame_comments(self.world_offset, self.enlargement)
        write_ply(path, raw_rows(self), self._find_degree(), comments, shards=self.shards)

    @property
    def size_as_ply(self) -> int:
        """Size of the PLY without its header."""
        return self.gaussian_count * row_bytes(self.max_sh_degree)

    def part(self, keep: Tensor | slice, sh_degree: int) -> "GaussianParameters":
        """A copy of the Gaussians `keep`, (N,) bool or a slice, with the SH bands up to sh_degree; no optimiser."""
        rows = raw_rows(self)
        rest = rows.pop("f_rest")[:, : (sh_degree + 1) ** 2 - 1]
        rows = {name: values[keep] for name, values in rows.items()}
        rows["f_rest"] = to_host(rest, keep) if self.storage and is_spilled(rest) else rest[keep].contiguous()
        other = copy.copy(self)
        other.max_sh_degree, other.active_sh_degree = sh_degree, min(sh_degree, self.active_sh_degree)
        other.optimizer = None
        other.set_rows(rows)
        return other

    def rows(self) -> Rows:
        """Raw values by optimiser group, without gradient; they share the parameters' memory."""
        return raw_rows(self)

    def rows_at(self, indices: Tensor) -> Rows:
        """Copies of the raw values of the Gaussians (n,) int64, by optimiser group."""
        return {name: values.index_select(0, indices) for name, values in raw_rows(self).items()}

    def set_rows(self, rows: Rows) -> None:
        """Take raw values of any number of Gaussians by optimiser group, with new statistics, and no further columns.

        They move to the device that computes.
        """
        device = compute_device()
        params = {}
        for name in self._attributes:
            like = rows[name][:0].to(device)
            room = self.storage and self.storage.empty_for(name, like, len(rows[name]))
            params[name] = nn.Parameter(rows[name].to(device) if room is None else room.copy_(rows[name].detach()))
        self._take(params)
        self.columns = {}
        self.shards = self.shards.resized(len(self))
        self._zero_statistics()

    def take_whole(self, rows: Rows) -> None:
        """Do as set_rows with the rows of a whole model, of which this rank keeps its part."""
        self.set_rows({name: self.shards.own_rows(values) for name, values in rows.items()})

    def _take(self, params: dict[str, Tensor]) -> None:
        """Set the tensors of these attributes; tensors of other names are not the table's."""
        for name, attribute in self._attributes.items():
            if name in params:
                setattr(self, attribute.field, params[name])


_read_statistics = attrgetter(*NAMES)

# Read once, so that a getter is told from one that replaces it, in a subclass or in this class.
_GEOMETRY = GaussianParameters.get_opacity, GaussianParameters.get_scaling, GaussianParameters.get_rotation
_FEATURES = (GaussianParameters.get_features, GaussianParameters.get_features_dc, GaussianParameters.get_features_rest)
