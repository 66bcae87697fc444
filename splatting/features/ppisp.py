"""A model of photos as cameras make them (--appearance ppisp): exposure, white balance, vignetting and response."""

import argparse
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_renderer import photo_name, render
from gaussian_renderer.scored_views import ScoredViews
from groundwork.files.json_files import read_model_json
from groundwork.finding import Finding, note
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from scene.images.exposures import EXPOSURES
from scene.images.exposures import exposures as by_points
from scene.readers.info import CameraInfo, names_of_photos
from scene.readers.tracks import PhotoPoints
from scene.scene import Scene
from splatting.features.ppisp_appearance import UNTRAINED, PhotoAppearance, appearance_of, read_appearance
from splatting.iteration import Iteration, Term
from splatting.part import Appearance, Needs, Scored
from splatting.records.renders import FITTED
from utils.image_utils import as_float, half
from utils.system_utils import UserError

_RECORDED = "appearance"  # option in model.json, of a training that has one


class Ppisp(Appearance):
    """Trains the numbers of photos and of their cameras.

    It allows no resets of opacities, after which haze could grow before cameras.
    """

    name = kind = "ppisp"
    needs = Needs(captured=True, resets=False, length=True)  # length: for its learning rate

    def cameras(self, scene: Scene, cameras: Sequence[tuple[Camera, CameraInfo]], held_out: bool) -> None:
        """Name the appearance by which each camera shows a render; held-out views have none that is trained."""
        names = names_of_photos(scene.info)
        for camera, view in cameras:
            if held_out:
                camera.exposure_name = UNTRAINED
            elif (name := names.get(view.image_path, view.image_name)) != view.image_name:
                camera.exposure_name = name

    def begin(self, run: Any, state: Any) -> None:
        """Give the model the appearance of its photos, or that of the checkpoint. UserError for a single photo."""
        views = run.scene.info.train_cameras
        if len(views) < 2:
            raise UserError("--appearance ppisp needs at least two training photos; leave it out")
        self.photos = appearance_of(views)
        run.gaussians.exposures = self.photos
        if run.start:
            self.photos.training_setup(run.opt)
            if state is None:
                print(f"{run.start} has no exposures; all photos start without a correction")
            else:
                self.photos.restore(state)

    def terms(self, at: Iteration) -> dict[str, Term]:
        return {"appearance": lambda *_: self.photos.size_penalty(photo_name(at.camera))}

    def save(self, scene: Scene) -> None:
        scene.gaussians.save_exposures(scene.model_path)

    def load(self, scene: Scene, args: argparse.Namespace) -> None:
        """Read the trained numbers, unless the photos are of another scene, or the model was trained without them."""
        own = not getattr(args, "other_scene", "") and _RECORDED in read_model_json(args.model_path)
        views = scene.info.train_cameras
        scene.gaussians.exposures = read_appearance(args.model_path, views) if own else PhotoAppearance()

    def scored(self, scene: Scene, pipe: argparse.Namespace, background: Any) -> dict[str, Scored]:
        photos = getattr(scene.gaussians, "exposures", None)  # a model of other code may have none
        if not isinstance(photos, PhotoAppearance):
            return {}
        return {FITTED: (fitted_views(photos, pipe, background), scene.getTestCameras())}

    @staticmethod
    def advise(scene: Scene, tracks: Sequence[PhotoPoints | None]) -> Iterator[Finding]:
        """Measure how far the exposures of the photos differ."""
        if any(tracks):
            cameras = sorted(scene.getTrainCameras(), key=lambda camera: camera.uid)
            spread = float(exposures(cameras, tracks).std())
            asked = "--appearance ppisp" if spread > EXPOSURES else ""
            yield note(f"exposures of the photos differ by {spread:.2f} stops", asked)


def fitted_views(photos: PhotoAppearance, pipe: argparse.Namespace, background: Tensor) -> ScoredViews:
    """Return views that score the right halves of held-out photos, with exposure and balance fitted to the left halves.

    The trained numbers stay as they are (the protocol of Martin-Brualla et al. 2021, NeRF in the Wild).
    """

    def draw(camera: Camera, gaussians: GaussianModel) -> Tensor:
        """Render a view (3, H, W), with exposure and balance fitted to the left half of its photo."""
        options = {"want_depth": False, "want_visibility": False, "clamp": False}
        image = render(camera, gaussians, pipe, background, **options)["render"]
        target, mask = camera.ground_truth(background)
        counts = torch.zeros_like(image[:1], dtype=torch.bool)
        counts[..., half(image.shape[-1], of_test_view=False)] = True
        counts = counts if mask is None else counts & mask
        return photos.fitted(image, as_float(target), counts, camera.colmap_id)

    return ScoredViews(pipe, background, True, draw)


def exposures(cameras: list[Camera], tracks: list[PhotoPoints | None]) -> np.ndarray:
    """Return the exposures (K,) of the photos that have a track, in stops around their mean."""
    colors, points = [], []
    for track, camera in zip(tracks, cameras, strict=True):
        if track is None:
            continue
        image = as_float(camera.target(torch.zeros(3, device=camera.device))).cpu().numpy()
        column, row = (track.places * image.shape[:0:-1]).astype(int).T
        inside = (column >= 0) & (column < image.shape[2]) & (row >= 0) & (row < image.shape[1])
        colors.append(image[:, row[inside], column[inside]].T)
        points.append(track.ranks[inside])
    return by_points(colors, points)
