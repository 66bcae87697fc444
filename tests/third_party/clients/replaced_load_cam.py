"""A wrapper that puts its own `loadCam` in the place of the project's, and then trains as usual.

SCENE MODEL OUT
"""

import json
import os
import sys
from types import SimpleNamespace

import torch
from PIL import Image

import utils.camera_utils as camera_utils
from gaussian_renderer import GaussianModel, render
from scene import Scene
from scene.cameras import Camera
from scene.dataset_readers import sceneLoadTypeCallbacks
from utils.loss_utils import l1_loss

loaded = []


def load_half(args, id, cam_info, resolution_scale, is_nerf_synthetic, is_test_dataset):
    """A camera at half of the usual size, whose photo is open only as long as it is read."""
    with Image.open(cam_info.image_path) as photo:
        image = photo.convert("RGB")
    loaded.append((cam_info.image_name, is_nerf_synthetic, is_test_dataset, cam_info.depth_path))
    scale = 2 * resolution_scale
    return Camera((int(image.width / scale), int(image.height / scale)), colmap_id=cam_info.uid,
                  R=cam_info.R, T=cam_info.T, FoVx=cam_info.FovX, FoVy=cam_info.FovY,
                  depth_params=cam_info.depth_params, image=image, invdepthmap=None, image_name=cam_info.image_name,
                  uid=id, data_device=args.data_device, train_test_exp=args.train_test_exp,
                  is_test_dataset=is_test_dataset, is_test_view=cam_info.is_test)  # fmt: skip


camera_utils.loadCam = load_half

source, model, out = sys.argv[1:4]
dataset = SimpleNamespace(
    sh_degree=3, source_path=source, model_path=os.path.join(out, "trained"), images="images", depths="",
    resolution=-1, white_background=False, train_test_exp=False, data_device="cuda", eval=True,
)  # fmt: skip
opt = SimpleNamespace(
    position_lr_init=0.00016, position_lr_final=0.0000016, position_lr_delay_mult=0.01, position_lr_max_steps=30_000,
    feature_lr=0.0025, opacity_lr=0.025, scaling_lr=0.005, rotation_lr=0.001, percent_dense=0.01, iterations=30,
    exposure_lr_init=0.01, exposure_lr_final=0.001, exposure_lr_delay_steps=0, exposure_lr_delay_mult=0.0,
)  # fmt: skip
pipe = SimpleNamespace(convert_SHs_python=False, compute_cov3D_python=False, debug=False, antialiasing=False)
os.makedirs(dataset.model_path, exist_ok=True)
gaussians = GaussianModel(dataset.sh_degree)
scene = Scene(dataset, gaussians, resolution_scales=[1.0, 2.0])
made = list(loaded)
gaussians.training_setup(opt)
background = torch.zeros(3, device="cuda")
losses = []
for iteration in range(1, opt.iterations + 1):
    gaussians.update_learning_rate(iteration)
    camera = scene.getTrainCameras()[iteration % 3]
    loss = l1_loss(render(camera, gaussians, pipe, background)["render"], camera.original_image.cuda())
    loss.backward()
    losses.append(loss.item())
    gaussians.optimizer.step()
    gaussians.optimizer.zero_grad(set_to_none=True)

# The list by itself, in the order of arguments of the October 2024 release.
info = sceneLoadTypeCallbacks["Colmap"](source, "images", "", True, False)
listed = camera_utils.cameraList_from_camInfos(info.test_cameras, 1.0, dataset, info.is_nerf_synthetic, True)
result = {
    "losses": losses,
    "loaded": [name for name, *_ in made],
    "synthetic": [synthetic for _, synthetic, *_ in made],
    "test": sum(is_test for *_, is_test, _ in made),
    "depth_paths": sorted({path for *_, path in made}),
    "sizes": [
        sorted({(c.image_width, c.image_height) for c in scene.getTrainCameras(scale) + scene.getTestCameras(scale)})
        for scale in (1.0, 2.0)
    ],
    "listed": [(camera.uid, camera.image_name, list(camera.original_image.shape)) for camera in listed],
}
with open(os.path.join(out, "result.json"), "w") as file:
    json.dump(result, file)
