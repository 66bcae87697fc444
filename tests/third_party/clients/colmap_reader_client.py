"""A tool around datasets: reads COLMAP files record by record, builds records of its own, reads and writes clouds.

SCENE MODEL OUT
"""

import json
import os
import sys

import numpy as np
import torch

from scene import GaussianModel
from scene.colmap_loader import (
    qvec2rotmat,
    read_extrinsics_binary,
    read_extrinsics_text,
    read_intrinsics_binary,
    read_intrinsics_text,
    read_points3D_binary,
    read_points3D_text,
    rotmat2qvec,
)
from scene.dataset_readers import (
    CameraInfo,
    SceneInfo,
    fetchPly,
    getNerfppNorm,
    readColmapSceneInfo,
    sceneLoadTypeCallbacks,
    storePly,
)
from utils.camera_utils import camera_to_JSON
from utils.graphics_utils import BasicPointCloud, focal2fov, fov2focal

source, model, out = sys.argv[1:4]
text = sys.argv[4]  # the same model as text files
sparse = os.path.join(source, "sparse", "0")
images = read_extrinsics_binary(os.path.join(sparse, "images.bin"))
cameras = read_intrinsics_binary(os.path.join(sparse, "cameras.bin"))
xyzs, rgbs, errors = read_points3D_binary(os.path.join(sparse, "points3D.bin"))
images_text = read_extrinsics_text(os.path.join(text, "images.txt"))
cameras_text = read_intrinsics_text(os.path.join(text, "cameras.txt"))
xyzs_text, rgbs_text, errors_text = read_points3D_text(os.path.join(text, "points3D.txt"))

infos = []
for key in images:
    extr = images[key]
    intr = cameras[extr.camera_id]
    assert intr.model == "PINHOLE" and len(intr.params) == 4 and extr.id == key
    infos.append(
        CameraInfo(
            uid=intr.id,
            R=np.transpose(qvec2rotmat(extr.qvec)),
            T=np.array(extr.tvec),
            FovY=focal2fov(intr.params[1], intr.height),
            FovX=focal2fov(intr.params[0], intr.width),
            depth_params=None,
            image_path=os.path.join(source, "images", extr.name),
            image_name=extr.name,
            depth_path="",
            width=intr.width,
            height=intr.height,
            is_test=False,
        )  # fmt: skip
    )
infos = sorted(infos.copy(), key=lambda info: info.image_name)
normalization = getNerfppNorm(infos)
cloud = BasicPointCloud(points=xyzs, colors=rgbs / 255.0, normals=np.zeros_like(xyzs))
own = SceneInfo(
    point_cloud=cloud,
    train_cameras=infos,
    test_cameras=[],
    nerf_normalization=normalization,
    ply_path="",
    is_nerf_synthetic=False,
)
read = readColmapSceneInfo(source, "images", "", False, False)
unnamed = readColmapSceneInfo(path=source, images=None, depths="", eval=True, train_test_exp=False)
called = sceneLoadTypeCallbacks["Colmap"](source, "images", "", True, False)
exposed = sceneLoadTypeCallbacks["Colmap"](source, "images", "", True, True)

os.makedirs(out, exist_ok=True)
path = os.path.join(out, "points.ply")
storePly(path, xyzs, rgbs)
fetched = fetchPly(path)
gaussians = GaussianModel(3)
gaussians.create_from_pcd(fetched, own.train_cameras, own.nerf_normalization["radius"])
first = images[min(images)]
seen = first.point3D_ids[first.point3D_ids >= 0]
entry = camera_to_JSON(3, infos[0])


def difference(a, b):
    return float(np.abs(np.asarray(a, dtype=np.float64) - np.asarray(b, dtype=np.float64)).max())


result = {
    "counts": [len(images), len(cameras), *xyzs.shape, *rgbs.shape, len(errors)],
    "text_images": max(
        difference(images[k].qvec, images_text[k].qvec) + difference(images[k].tvec, images_text[k].tvec)
        for k in images
    ),
    "text_names": [images[k].name for k in images] == [images_text[k].name for k in images],
    "text_points2d": max(difference(images[k].xys, images_text[k].xys) for k in images),
    "text_ids": all((images[k].point3D_ids == images_text[k].point3D_ids).all() for k in images),
    "text_cameras": max(difference(cameras[k].params, cameras_text[k].params) for k in cameras),
    "text_points": difference(np.sort(xyzs, axis=0), np.sort(xyzs_text, axis=0)),
    "text_colors": difference(np.sort(rgbs, axis=0), np.sort(rgbs_text, axis=0)),
    "text_errors": difference(np.sort(np.ravel(errors)), np.sort(np.ravel(errors_text))),
    "method": difference(first.qvec2rotmat(), qvec2rotmat(first.qvec)),
    "roundtrip": min(difference(rotmat2qvec(first.qvec2rotmat()), sign * first.qvec) for sign in (1, -1)),
    "sightings": [len(first.xys), len(first.point3D_ids), len(seen)],
    "infos": max(
        difference(a.R, b.R) + difference(a.T, b.T) + abs(a.FovX - b.FovX) + abs(a.FovY - b.FovY)
        for a, b in zip(infos, read.train_cameras, strict=True)
    ),
    "same_names": [info.image_name for info in infos] == [info.image_name for info in read.train_cameras],
    "same_paths": all(
        os.path.samefile(a.image_path, b.image_path) for a, b in zip(infos, read.train_cameras, strict=True)
    ),
    "radius": [own.nerf_normalization["radius"], read.nerf_normalization["radius"]],
    "translate": list(np.asarray(read.nerf_normalization["translate"]).shape),
    "synthetic": read.is_nerf_synthetic,
    "split": [
        len(unnamed.train_cameras),
        len(unnamed.test_cameras),
        len(called.train_cameras),
        len(called.test_cameras),
    ],
    "exposed": [len(exposed.train_cameras), len(exposed.test_cameras)],
    "is_test": [sum(info.is_test for info in exposed.train_cameras), all(info.is_test for info in called.test_cameras)],
    "cloud": [*read.point_cloud.points.shape, *read.point_cloud.colors.shape],
    "fetched": [difference(fetched.points, xyzs), difference(fetched.colors, rgbs / 255.0)],
    "gaussians": [len(gaussians.get_xyz), float(gaussians.spatial_lr_scale)],
    "created": (gaussians.get_xyz - torch.tensor(xyzs, dtype=torch.float32).cuda()).abs().max().item(),
    "json": [*entry, entry["id"], entry["width"], entry["fx"] - fov2focal(infos[0].FovX, infos[0].width)],
}
with open(os.path.join(out, "result.json"), "w") as file:
    json.dump(result, file)
