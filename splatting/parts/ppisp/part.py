"""Photos as cameras make them (--appearance ppisp): their exposure, white balance, vignetting and response."""

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from splatting.part import Appearance, Needs, Scored, fill
from utils.system_utils import UserError

if TYPE_CHECKING:
    from scene.cameras import Camera
    from scene.readers.info import CameraInfo
    from scene.scene import Scene
    from splatting.training.iteration import Iteration, Term

_RECORDED = "appearance"  # option in model.json, of a training that has one


class Ppisp(Appearance):
    """Trains the numbers of photos and of their cameras. Haze can grow before cameras after a reset of opacities."""

    name = kind = "ppisp"
    tools = ("advise",)
    summary = (
        "exposure and white balance of each photo, vignetting and response of each camera, with the test photos held "
        "out, and without resets of opacities at their usual interval"
    )
    needs = Needs(captured=True, bright=True)

    def cameras(self, scene: "Scene", cameras: "Sequence[tuple[Camera, CameraInfo]]", held_out: bool) -> None:
        from scene.readers.info import names_of_photos
        from splatting.parts.ppisp.appearance import UNTRAINED

        names = names_of_photos(scene.info)
        for camera, view in cameras:
            if held_out:
                camera.exposure_name = UNTRAINED
            elif (name := names.get(view.image_path, view.image_name)) != view.image_name:
                camera.exposure_name = name

    def begin(self, run: Any, state: Any) -> None:
        from splatting.parts.ppisp.appearance import appearance_of

        views = run.scene.info.train_cameras
        if len(views) < 2:
            raise UserError("--appearance ppisp needs at least two training photos; leave it out")
        self.photos = appearance_of(views)
        fill(run.gaussians, "exposures", self.photos, self)
        if run.start:
            self.photos.training_setup(run.opt)
            if state is None:
                print(f"{run.start} has no exposures; all photos start without a correction")
            else:
                self.photos.restore(state)

    def terms(self, at: "Iteration") -> "dict[str, Term]":
        from gaussian_renderer import photo_name

        return {"appearance": lambda *_: self.photos.pull(photo_name(at.camera))}

    def save(self, scene: "Scene") -> None:
        scene.gaussians.save_exposures(scene.model_path)

    def load(self, scene: "Scene", args: argparse.Namespace) -> None:
        """Photos of another scene, and of a model that was trained without, have nothing trained."""
        from splatting.files.json_files import read_model_json
        from splatting.parts.ppisp.appearance import PhotoAppearance, read_appearance

        own = not getattr(args, "other_scene", "") and _RECORDED in read_model_json(args.model_path)
        views = scene.info.train_cameras
        photos = read_appearance(args.model_path, views) if own else PhotoAppearance()
        fill(scene.gaussians, "exposures", photos, self)

    def scored(self, scene: "Scene", pipe: argparse.Namespace, background: Any) -> dict[str, Scored]:
        from splatting.evaluation.comparison import FITTED
        from splatting.parts.ppisp.appearance import PhotoAppearance
        from splatting.parts.ppisp.fitted import fitted_views

        photos = getattr(scene.gaussians, "exposures", None)  # a model of other code may have none
        if not isinstance(photos, PhotoAppearance):
            return {}
        return {FITTED: (fitted_views(photos, pipe, background), scene.getTestCameras())}
