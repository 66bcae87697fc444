"""A viewer: arrays from a PLY, a camera of its own, and the 2023 rasterizer without a tensor for screen positions.

SCENE MODEL OUT
"""

import json
import math
import os
import sys
from dataclasses import dataclass

import numpy as np
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer
from PIL import Image
from plyfile import PlyData


@dataclass
class GaussianData:
    xyz: np.ndarray
    rot: np.ndarray
    scale: np.ndarray
    opacity: np.ndarray
    sh: np.ndarray

    def cuda(self):
        return {name: torch.tensor(values).float().cuda().requires_grad_(False) for name, values in vars(self).items()}


def load_ply(path):
    """Activated values; SH coefficients as (N, 48)."""
    vertices = PlyData.read(path).elements[0]

    def columns(prefix):
        names = [p.name for p in vertices.properties if p.name.startswith(prefix)]
        names.sort(key=lambda name: int(name.split("_")[-1]))
        return np.stack([np.asarray(vertices[name]) for name in names], axis=1).astype(np.float32)

    xyz = np.stack([np.asarray(vertices[axis]) for axis in "xyz"], axis=1)
    opacity = 1 / (1 + np.exp(-np.asarray(vertices["opacity"])))[:, None]
    rest = columns("f_rest_").reshape(len(xyz), 3, 15).transpose(0, 2, 1).reshape(len(xyz), -1)
    rotation = columns("rot")
    rotation /= np.linalg.norm(rotation, axis=-1, keepdims=True)
    return GaussianData(
        xyz, rotation, np.exp(columns("scale_")), opacity, np.concatenate([columns("f_dc_"), rest], axis=-1)
    )


class ViewerCamera:
    """Matrices as an OpenGL viewer computes them, from pose and focal length."""

    def __init__(self, entry):
        self.w, self.h = entry["width"], entry["height"]
        self.tanx, self.tany = self.w / (2 * entry["fx"]), self.h / (2 * entry["fy"])
        self.position = np.array(entry["position"], dtype=np.float32)
        self.view = np.eye(4, dtype=np.float32)
        self.view[:3, :3] = np.array(entry["rotation"]).T
        self.view[:3, 3] = -self.view[:3, :3] @ self.position
        near, far = 0.01, 100.0
        self.projection = np.zeros((4, 4), dtype=np.float32)
        self.projection[0, 0], self.projection[1, 1] = 1 / self.tanx, 1 / self.tany
        self.projection[2, 2], self.projection[2, 3] = far / (far - near), -far * near / (far - near)
        self.projection[3, 2] = 1.0


source, model, out = sys.argv[1:4]
data = load_ply(os.path.join(model, "point_cloud", "iteration_300", "point_cloud.ply")).cuda()
with open(os.path.join(model, "cameras.json")) as file:
    camera = ViewerCamera(json.load(file)[0])  # the first test view
settings = {
    "image_height": camera.h, "image_width": camera.w, "tanfovx": camera.tanx, "tanfovy": camera.tany,
    "bg": torch.Tensor([0.0, 0.0, 0.0]).float().cuda(), "scale_modifier": 1.0,
    "viewmatrix": torch.tensor(camera.view.T).float().cuda(),
    "projmatrix": torch.tensor((camera.projection @ camera.view).T).float().cuda(),
    "sh_degree": 3, "campos": torch.tensor(camera.position).float().cuda(), "prefiltered": False, "debug": False,
}  # fmt: skip
rasterizer = GaussianRasterizer(raster_settings=GaussianRasterizationSettings(**settings))


def draw():
    with torch.no_grad():
        img, radii = rasterizer(
            means3D=data["xyz"], means2D=None, shs=data["sh"].view(len(data["sh"]), -1, 3).contiguous(),
            colors_precomp=None, opacities=data["opacity"], scales=data["scale"], rotations=data["rot"],
            cov3D_precomp=None,
        )  # fmt: skip
    return img, radii


image, radii = draw()
visible = rasterizer.markVisible(data["xyz"])
data["opacity"] *= 0.0
empty, _ = draw()
array = (image.permute(1, 2, 0).clamp(0, 1).cpu().numpy() * 255 + 0.5).astype(np.uint8)
Image.fromarray(array).save(os.path.join(out, "view.png"))
by_position = GaussianRasterizationSettings(*settings.values())
result = {
    "seen": image.max().item(),
    "empty": empty.max().item(),
    "radii": [list(radii.shape), str(radii.dtype), int((radii > 0).sum()), int(visible.sum())],
    "fields": [by_position.image_width, by_position.debug, math.isclose(by_position.tanfovx, camera.tanx)],
}
with open(os.path.join(out, "result.json"), "w") as file:
    json.dump(result, file)
