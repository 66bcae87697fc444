"""Parameters of N Gaussians: raw tensors, their activated forms, and the PLY they are kept in."""

import copy
import os

import torch
from torch import Tensor, nn

from scene.gaussians.attributes import Rows, attributes
from scene.gaussians.finite import tell_of_undrawn
from scene.gaussians.ply import read_ply, row_bytes, write_ply
from utils.general_utils import build_scaling_rotation, strip_symmetric
from utils.host.device import compute_device


class GaussianParameters:
    """N Gaussians with raw (unactivated) float32 parameters; `get_*` give the activated ones.

    `_xyz` (N,3) world; `_features_dc` (N,1,3), `_features_rest` (N,K,3), K = (D+1)^2 - 1; `_scaling` (N,3) log;
    `_rotation` (N,4) wxyz, any length; `_opacity` (N,1) logit. world_offset: the world's coordinates of the origin
    (scene/readers/world_offset.py), kept in the PLY.
    """

    _xyz: nn.Parameter
    _features_dc: nn.Parameter
    _features_rest: nn.Parameter
    _scaling: nn.Parameter
    _rotation: nn.Parameter
    _opacity: nn.Parameter

    def __init__(self, sh_degree: int) -> None:
        self.active_sh_degree = 0
        self.max_sh_degree = sh_degree
        self.world_offset = (0.0, 0.0, 0.0)
        self._attributes = attributes(sh_degree)
        self.set_rows({name: torch.empty(0, *attribute.shape) for name, attribute in self._attributes.items()})

    def __len__(self) -> int:
        """Number of Gaussians."""
        return self._xyz.shape[0]

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
        return torch.exp(self._scaling)

    @property
    def get_rotation(self) -> Tensor:
        """Unit quaternions (N, 4), wxyz."""
        return nn.functional.normalize(self._rotation)

    @property
    def get_opacity(self) -> Tensor:
        """Opacities (N, 1) in (0, 1)."""
        return torch.sigmoid(self._opacity)

    def get_covariance(self, scaling_modifier: float = 1.0) -> Tensor:
        """World covariances R S S R^T, S = modifier * scales: (N, 6), order xx xy xz yy yz zz."""
        factor = build_scaling_rotation(scaling_modifier * self.get_scaling, self._rotation)
        return strip_symmetric(factor @ factor.transpose(1, 2))

    def raw_geometry(self) -> dict[str, Tensor]:
        """Raw shapes by the rasterizer's names: opacities (N, 1) logit, scales (N, 3) log, rotations (N, 4) wxyz."""
        return {"opacities": self.raw("opacity"), "scales": self.raw("scaling"), "rotations": self.raw("rotation")}

    def raw(self, name: str) -> Tensor:
        """Raw values (N, ...) of an attribute, by its name in the table of scene/gaussians/attributes.py."""
        return getattr(self, self._attributes[name].field)

    @property
    def active_bands(self) -> int:
        """Number of SH coefficients above band 0 that the active degree uses."""
        return (self.active_sh_degree + 1) ** 2 - 1

    def load_ply(self, path: str | os.PathLike) -> None:
        """Take all parameters from a PLY of this model's SH degree (else UserError); all SH bands become active."""
        rows = read_ply(path, self.max_sh_degree)
        tell_of_undrawn(rows, path)
        self.set_rows(rows)
        self.active_sh_degree = self.max_sh_degree

    def save_ply(self, path: str | os.PathLike) -> None:
        """Write the raw parameters as a PLY in the reference's layout."""
        write_ply(path, self.rows(), self.max_sh_degree, self.world_offset)

    @property
    def ply_bytes(self) -> int:
        """Size of the PLY without its header."""
        return len(self) * row_bytes(self.max_sh_degree)

    def part(self, keep: Tensor | slice, sh_degree: int) -> "GaussianParameters":
        """A copy of the Gaussians `keep`, (N,) bool or a slice, with the SH bands up to sh_degree."""
        rows = {name: values[keep] for name, values in self.rows().items()}
        rows["f_rest"] = rows["f_rest"][:, : (sh_degree + 1) ** 2 - 1].contiguous()
        other = copy.copy(self)
        other.max_sh_degree, other.active_sh_degree = sh_degree, min(sh_degree, self.active_sh_degree)
        other._attributes = attributes(sh_degree)
        other.set_rows(rows)
        return other

    def rows(self) -> Rows:
        """Raw values by optimiser group, without gradient; they share the parameters' memory."""
        return {name: getattr(self, attribute.field).detach() for name, attribute in self._attributes.items()}

    def set_rows(self, rows: Rows) -> None:
        """Take raw values of any number of Gaussians by optimiser group; they move to the device that computes."""
        device = compute_device()
        self._take({name: nn.Parameter(rows[name].to(device)) for name in self._attributes})

    def _take(self, params: dict[str, nn.Parameter]) -> None:
        for name, param in params.items():
            setattr(self, self._attributes[name].field, param)
