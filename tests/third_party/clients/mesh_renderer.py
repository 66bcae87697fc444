"""The renderer of a mesh extractor: cameras of its own by position, as the 2023 release makes them, in stereo pairs.

SCENE MODEL OUT
"""

import json
import os
import sys
from argparse import ArgumentParser, Namespace

import numpy as np
import torch
from PIL import Image

from arguments import ModelParams, PipelineParams
from gaussian_renderer import render
from scene import GaussianModel, Scene, cameras

BASELINE = 0.05  # of the distance to the origin


class Renderer:
    def __init__(self, source, model, out):
        # The settings of the whole program; only some are the reconstruction's.
        args = Namespace(
            colmap_name="scene", source_path=source, model_path=model, images="images", resolution=-1, sh_degree=3,
            white_background=False, data_device="cuda", eval=True, stereo_model="none", TSDF_voxel=2, video_interval=10,
            convert_SHs_python=False, compute_cov3D_python=False, debug=False, quiet=True, baseline=BASELINE,
        )  # fmt: skip
        parser = ArgumentParser()
        self.dataset = ModelParams(parser, sentinel=True).extract(args)
        self.dataset.mesh_folder = out
        self.pipe = PipelineParams(parser).extract(args)
        self.gaussians = GaussianModel(self.dataset.sh_degree)
        self.scene = Scene(self.dataset, self.gaussians, load_iteration=300, shuffle=False)
        self.background = torch.tensor([0, 0, 0], dtype=torch.float32, device="cuda")

    def camera(self, view, R, T, name):
        h, w = view.image_height, view.image_width
        return cameras.Camera(0, R, T, view.FoVx, view.FoVy, torch.rand(3, h, w), None, name, 0)

    @torch.no_grad()
    def draw(self, camera, path):
        image = render(camera, self.gaussians, self.pipe, self.background)["render"]
        array = (image.permute(1, 2, 0).clamp(0, 1).cpu().numpy() * 255 + 0.5).astype(np.uint8)
        Image.fromarray(array).save(path)
        return image

    def stereo_pair(self, view, folder):
        """The view itself, and a second one to its right: the translation changes along the camera's own x axis."""
        os.makedirs(folder, exist_ok=True)
        baseline = BASELINE * float(np.linalg.norm(view.T))
        left = self.camera(view, view.R, view.T, "left")
        right = self.camera(view, view.R, view.T - np.array([baseline, 0, 0]), "right")
        images = [self.draw(camera, os.path.join(folder, f"{camera.image_name}.png")) for camera in (left, right)]
        moved = (right.camera_center - left.camera_center).cpu().numpy() - view.R[:, 0] * baseline
        return {
            "moved_wrong": float(np.abs(moved).max()),
            "differ": (images[0] - images[1]).abs().mean().item(),
            "size": [left.image_width, left.image_height],
            "image": list(left.original_image.shape),
            "in_range": bool((left.original_image >= 0).all() and (left.original_image <= 1).all()),
        }


source, model, out = sys.argv[1:4]
renderer = Renderer(source, model, out)
views = renderer.scene.getTrainCameras()[:3]
pairs = [renderer.stereo_pair(view, os.path.join(out, f"{index:03}")) for index, view in enumerate(views)]
with open(os.path.join(out, "result.json"), "w") as file:
    json.dump({"pairs": pairs, "names": [view.image_name for view in views]}, file)
