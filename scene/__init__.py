"""Datasets and models.

scene                        Scene: the views of a dataset and the Gaussians that belong to them
view                         View: matrices and photo of a view
cameras, camera_forms        the reference's names for views: Camera, a View that may be changed, and MiniCam
gaussian_model               GaussianModel, built of the modules in gaussians/
gaussians/                   parameters of the Gaussians: start, optimiser, density control, exposures, PLY, checkpoint
dataset_readers, readers/    a folder's dataset as CameraInfos: COLMAP, Blender, nerfstudio; points, depth maps
colmap_loader                COLMAP's files as records
images/                      image files: finding, lenses, masks, decoding, keeping
saved_model                  the saves in a model folder, and loading one with its scene
splats/, with_splats         Gaussians of any tool's file, with a scene: a start of a training (--init_ply), or shown
export_world                 a command: a model in the world's coordinates

gaussians/ and images/ import nothing else from here, readers/ only images/ and colmap_loader, splats/ only gaussians/
and readers/, and nothing here imports `arguments`, because other people's code may have its own package of that name.
The names below are imported on first use, so that `import scene.gaussian_model` loads no reader of datasets.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from scene.gaussian_model import GaussianModel
    from scene.scene import Scene, SceneGaussians

__all__ = ["GaussianModel", "Scene", "SceneGaussians"]

_HOMES = {
    "GaussianModel": "scene.gaussian_model",
    "ModelParams": "arguments",  # of whoever's package has that name
    "Scene": "scene.scene",
    "SceneGaussians": "scene.scene",
    "cameraList_from_camInfos": "utils.camera_utils",
    "camera_to_JSON": "utils.camera_utils",
    "sceneLoadTypeCallbacks": "scene.dataset_readers",
    "searchForMaxIteration": "utils.system_utils",
}
_MODULES = ("cameras", "colmap_loader", "dataset_readers", "gaussian_model")


def __getattr__(name: str) -> object:
    """Import a module, or a name that lives in one, when it is first read."""
    if name in _MODULES:
        return import_module(f"scene.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        home = import_module(_HOMES[name])
    except ModuleNotFoundError as error:
        if error.name != "arguments":
            raise
        raise AttributeError(f"module {__name__!r} has no {name}: there is no package arguments") from error
    return getattr(home, name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES, *_MODULES])
