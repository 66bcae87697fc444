"""A project that has the repository as its package folder `gaussian_splatting`, beside absolute imports of the same.

SCENE MODEL OUT
"""

import json
import os
import sys

import numpy as np
import torch
from diff_gaussian_rasterization import GaussianRasterizer
from gaussian_splatting.gaussian_renderer import render as gs_render
from gaussian_splatting.scene.cameras import Camera as GSCamera
from gaussian_splatting.scene.dataset_readers import fetchPly
from gaussian_splatting.scene.gaussian_model import GaussianModel
from gaussian_splatting.utils.graphics_utils import focal2fov
from PIL import Image
from simple_knn._C import distCUDA2

import scene


class PipelineParams:
    convert_SHs_python = False
    compute_cov3D_python = False
    debug = False


def load_cameras(model_path, source_path):
    """Cameras from cameras.json, each with its photo as a tensor."""
    with open(os.path.join(model_path, "cameras.json")) as file:
        entries = sorted(json.load(file), key=lambda entry: entry["img_name"])
    for number, entry in enumerate(entries):
        rotation = np.array(entry["rotation"])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, entry["position"]
        view = np.linalg.inv(pose)
        with Image.open(os.path.join(source_path, "images", entry["img_name"])) as photo:
            image = torch.from_numpy(np.array(photo) / 255.0).float().permute(2, 0, 1)
        yield GSCamera(
            colmap_id=entry["id"],
            R=view[:3, :3].T,
            T=view[:3, 3],
            FoVx=focal2fov(entry["fx"], entry["width"]),
            FoVy=focal2fov(entry["fy"], entry["height"]),
            image=image,
            gt_alpha_mask=None,
            image_name=entry["img_name"],
            uid=number,
        )


source, model, out = sys.argv[1:4]
gaussians = GaussianModel(3)
gaussians.load_ply(os.path.join(model, "point_cloud", "iteration_300", "point_cloud.ply"))
cameras = list(load_cameras(model, source))
background = torch.zeros(3, device="cuda")
scores = []
with torch.no_grad():
    for camera in cameras:
        image = gs_render(camera, gaussians, PipelineParams(), background)["render"]
        scores.append(-10 * ((image - camera.original_image.cuda()) ** 2).mean().log10().item())
    Image.fromarray((image.permute(1, 2, 0).cpu().numpy() * 255 + 0.5).astype(np.uint8)).save(
        os.path.join(out, "last.png")
    )
points = fetchPly(os.path.join(model, "input.ply")).points
distances = distCUDA2(torch.from_numpy(np.asarray(points)).float().cuda())
result = {
    "scores": scores,
    "last": cameras[-1].image_name,
    "points": len(points),
    "distances": [distances.min().item(), distances.max().item()],
    "absolute": [scene.__name__, scene.GaussianModel.__name__, GaussianRasterizer.__name__],
}
with open(os.path.join(out, "result.json"), "w") as file:
    json.dump(result, file)
