"""USDZ: the schema ParticleField3DGaussianSplat of OpenUSD 26.3 and later, all attributes float32.

Scales are linear and opacities in [0, 1]; SH coefficients lie splat by splat. The stage's y is up. The values are those
of the model, in COLMAP's axes, and the prim turns them half around x.
"""

import os
import zipfile
from pathlib import Path
from types import ModuleType

import numpy as np

from exports.selection import opacities
from exports.splats import Splats
from utils.system_utils import UserError, atomic_write, temporary_folder

PRIM = "/World/Splats"


def write_usdz(path: str | os.PathLike, splats: Splats) -> None:
    """Write the file, whole or not at all. UserError without a usd-core that has the schema."""
    usd = find_pxr(path)
    with temporary_folder() as folder, atomic_write(path) as temporary:
        layer = folder / "splats.usdc"
        try:
            _write_stage(usd, str(layer), splats)
            done = usd.UsdUtils.CreateNewUsdzPackage(usd.Sdf.AssetPath(str(layer)), str(temporary))
        except usd.Tf.ErrorException:
            done = False
        if not done or not _is_whole(temporary):
            raise UserError(
                f"cannot write {path}; free space there and in {folder.parent}, fix the permissions, or choose "
                "another place"
            )


def _is_whole(package: Path) -> bool:
    """Whether a package has all of its bytes: OpenUSD does not tell of a disk that was full."""
    try:
        with zipfile.ZipFile(package) as archive:
            return archive.testzip() is None
    except zipfile.BadZipFile:
        return False


def find_pxr(path: str | os.PathLike) -> ModuleType:
    """The package that a file of this name needs. UserError without it."""
    try:
        import pxr
        from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdUtils, UsdVol, Vt  # noqa: F401  (so that pxr has them)

        UsdVol.ParticleField3DGaussianSplat  # noqa: B018
    except (ImportError, AttributeError) as error:
        reason = "needs the package usd-core, 26.3 or later"
        raise UserError(f"{path} {reason}; install it with pip install '.[export]'") from error
    return pxr


def _write_stage(usd: ModuleType, layer: str, splats: Splats) -> None:
    stage = usd.Usd.Stage.CreateNew(layer)
    usd.UsdGeom.SetStageUpAxis(stage, usd.UsdGeom.Tokens.y)
    usd.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(usd.UsdGeom.Xform.Define(stage, "/World").GetPrim())
    field = usd.UsdVol.ParticleField3DGaussianSplat.Define(stage, PRIM)
    usd.UsdGeom.Xformable(field).AddRotateXOp().Set(180.0)
    field.GetPrim().SetCustomDataByKey("antialiasing", bool(splats.antialiasing))
    vt = usd.Vt
    xyzw = np.ascontiguousarray(np.roll(splats.rotations, -1, axis=1))  # Gf keeps the real part last
    alpha = opacities(splats).astype(np.float32)
    values = {
        "positions": vt.Vec3fArray.FromNumpy(splats.means),
        "orientations": vt.QuatfArray.FromNumpy(xyzw),
        "scales": vt.Vec3fArray.FromNumpy(np.exp(splats.log_scales)),
        "opacities": vt.FloatArray.FromNumpy(alpha),
        "radiance:sphericalHarmonicsDegree": splats.sh_degree,
        "radiance:sphericalHarmonicsCoefficients": vt.Vec3fArray.FromNumpy(splats.sh.reshape(-1, 3)),
    }
    for name, value in values.items():
        field.GetPrim().GetAttribute(name).Set(value)
    # The kernel reaches three standard deviations; bounds let programs frame and cull the splats.
    reach = 3 * np.exp(splats.log_scales.max(axis=1, keepdims=True)) if len(splats) else splats.means
    bounds = (
        [(splats.means - reach).min(axis=0), (splats.means + reach).max(axis=0)] if len(splats) else np.zeros((2, 3))
    )
    extent = field.GetPrim().GetAttribute("extent")
    extent.Set(vt.Vec3fArray.FromNumpy(np.asarray(bounds, np.float32)))
    stage.GetRootLayer().Save()
