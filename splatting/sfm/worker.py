"""pycolmap's long steps in their own process: `python worker.py JOB.json`, a file with {"step": ..., ...}.

In another process, steps can be stopped at once, log to a file, and do not crash the caller when they crash. The worker
ends when its standard input closes, so it does not outlive a caller that was killed. It imports nothing of the project,
since only its own folder is on the path.
"""

import json
import os
import shutil
import sys
import threading
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

SEED = 0
FEWEST_SEEN = 50  # points of a photo that tell its focal length
MOST_SEEN = 400  # that are asked: more take longer and tell no more
_NEIGHBOURS, _SHOWN = 30, 5000  # other photos of a photo, and points, in capture.json


def features(job: dict[str, Any]) -> None:
    """Write SIFT features of groups of photos into a new database, with one camera per group."""
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = job["camera"]
    if job["masks"]:
        reader.mask_path = job["masks"]
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = job["max_num_features"]
    pycolmap.Database.open(job["database"]).close()
    # Import the photos first, in order: threads would number them in the order in which they happen to finish. The
    # camera of a group begins with the focal length that the EXIF data of its first photo tell, if they do.
    for names in job["groups"]:
        pycolmap.import_images(job["database"], job["images"], pycolmap.CameraMode.SINGLE, names, reader)
    names = [name for group in job["groups"] for name in group]
    pycolmap.extract_features(
        job["database"], job["images"], names, pycolmap.CameraMode.AUTO, reader, options, _device(job)
    )


def matching(job: dict[str, Any]) -> None:
    """Match and verify pairs of photos; skip pairs that the database already has."""
    match = {"exhaustive": pycolmap.match_exhaustive, "sequential": pycolmap.match_sequential}[job["matcher"]]
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    match(job["database"], verification_options=verification, device=_device(job))


def mapping(job: dict[str, Any]) -> None:
    """Compute poses and points; write one or more models into sub-folders of `models`."""
    os.makedirs(job["models"])
    if job["mapper"] == "global":
        # Global mapping needs initial focal lengths; this estimates them from the pairs.
        pycolmap.calibrate_view_graph(job["database"])
        options = pycolmap.GlobalPipelineOptions()
        options.random_seed = SEED
        pycolmap.global_mapping(job["database"], job["images"], job["models"], options)
        return
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = SEED
    options.ba_global_function_tolerance = job["tolerance"]
    options.min_model_size = 3  # a small model is better than none; the report shows its size
    pycolmap.incremental_mapping(job["database"], job["images"], job["models"], options)


def survey(job: dict[str, Any]) -> None:
    """Write the contents of the models to the JSON file `out`."""
    models = []
    for folder in sorted(Path(job["models"]).iterdir()):
        try:
            model = pycolmap.Reconstruction(str(folder))
        except (ValueError, RuntimeError, IndexError):
            continue  # no model, or one whose writing was interrupted
        models.append(
            {
                "folder": folder.name,
                "registered": sorted(model.images[i].name for i in model.reg_image_ids()),
                "points": model.num_points3D(),
                "track_length": model.compute_mean_track_length(),
                "error": model.compute_mean_reprojection_error(),
                "cameras": [_camera(model, camera) for _, camera in sorted(model.cameras.items())],
            }
        )
    Path(job["out"]).write_text(json.dumps(models), encoding="utf-8")


def _camera(model: pycolmap.Reconstruction, camera: pycolmap.Camera) -> dict[str, Any]:
    """Describe a camera of a model. photos: by name, what `_refit` finds."""
    images = [model.images[i] for i in model.reg_image_ids() if model.images[i].camera_id == camera.camera_id]
    return {
        "id": camera.camera_id,
        "model": camera.model_name,
        "size": [camera.width, camera.height],
        "params": camera.params.tolist(),
        "photos": {image.name: _refit(model, image) for image in sorted(images, key=lambda one: one.name)},
    }


def _refit(model: pycolmap.Reconstruction, image: pycolmap.Image) -> list[float]:
    """Fit pose and focal length of one photo to its points, which stay where they are.

    Return the factor of the focal length, and the median error (pixels) before and after; nothing if it has few points.
    """
    numbers, camera = image.get_observation_point2D_idxs(), pycolmap.Camera(image.camera.todict())
    if len(numbers) < FEWEST_SEEN or not camera.focal_length_idxs():
        return []
    seen = [image.point2D(number) for number in numbers[:: -(-len(numbers) // MOST_SEEN)]]
    places = np.array([point.xy for point in seen])
    points = np.array([model.points3D[point.point3D_id].xyz for point in seen])
    options = pycolmap.AbsolutePoseRefinementOptions()
    options.refine_focal_length = True
    pose = image.cam_from_world()
    found = pycolmap.refine_absolute_pose(pose, places, points, np.ones(len(seen), bool), camera, options)
    if found is None:
        return []
    pairs = (image.camera, pose), (camera, found["cam_from_world"])
    errors = [np.linalg.norm(lens.img_from_cam(placed * points) - places, axis=1) for lens, placed in pairs]
    factor = camera.mean_focal_length() / image.camera.mean_focal_length()
    return [factor, *(float(np.nanmedian(error)) for error in errors)]


def capture(job: dict[str, Any]) -> None:
    """Write where the photos of a model stand, and which points they share, to the JSON file `out`."""
    model = pycolmap.Reconstruction(job["model"])
    images = {i: model.images[i] for i in model.reg_image_ids()}
    shared: dict[int, Counter] = {i: Counter() for i in images}
    for point in model.points3D.values():
        seen = {element.image_id for element in point.track.elements}
        for i in seen:
            shared[i].update(seen - {i})
    photos = {}
    for i, image in sorted(images.items(), key=lambda one: one[1].name):
        turn = image.cam_from_world().rotation.matrix()
        photos[image.name] = {
            "place": image.projection_center().tolist(),
            "view": turn[2].tolist(),
            "up": (-turn[1]).tolist(),
            "points": image.num_points3D,
            "shared": {images[other].name: count for other, count in shared[i].most_common(_NEIGHBOURS)},
        }
    chosen = sorted(model.points3D)[:: max(len(model.points3D) // _SHOWN, 1)]
    content = {
        "photos": photos,
        "points": [model.points3D[i].xyz.tolist() for i in chosen],
        "colors": [model.points3D[i].color.tolist() for i in chosen],
    }
    Path(job["out"]).write_text(json.dumps(content), encoding="utf-8")


def undistort(job: dict[str, Any]) -> None:
    """Write photos and model without lens distortion, in COLMAP's layout, into the folder `out`.

    Panoramas are taken as they are.
    """
    model, out = pycolmap.Reconstruction(job["model"]), Path(job["out"])
    if any(camera.model_name == "EQUIRECTANGULAR" for camera in model.cameras.values()):
        for name in [model.images[i].name for i in model.reg_image_ids()]:
            (out / "images" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(Path(job["images"], name), out / "images" / name)
        (out / "sparse").mkdir()
        model.write(str(out / "sparse"))
        return
    pycolmap.undistort_images(job["out"], job["model"], job["images"], jpeg_quality=job["jpeg_quality"])


def _device(job: dict[str, Any]) -> pycolmap.Device:
    return pycolmap.Device.cpu if job["no_gpu"] else pycolmap.Device.auto


def _end_with_input() -> None:
    # Do not read sys.stdin: its lock would be held when the interpreter shuts down.
    while os.read(0, 1024):
        pass
    os._exit(1)


STEPS = {step.__name__: step for step in (features, matching, mapping, survey, undistort, capture)}


def main(path: str) -> None:
    """Run the job of a file."""
    job = json.loads(Path(path).read_text(encoding="utf-8"))
    threading.Thread(target=_end_with_input, daemon=True).start()
    pycolmap.set_random_seed(SEED)
    STEPS[job["step"]](job)


if __name__ == "__main__":
    main(sys.argv[1])
