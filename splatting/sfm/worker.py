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
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

SEED = 0
THREADS = 1  # of mapping: several add numbers in the order in which they happen to finish
FISHEYE_ANGLE = 2.6  # radians along the longer side, 150 degrees: first guess for a fisheye


def features(job: dict[str, Any]) -> None:
    """Write SIFT features of groups of photos into a new database, with one camera per group, or with given cameras."""
    reader = pycolmap.ImageReaderOptions()
    if job["masks"]:
        reader.mask_path = job["masks"]
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = job["max_num_features"]
    pycolmap.Database.open(job["database"]).close()
    given = job["mapper"] == "triangulation"
    mode = pycolmap.CameraMode.AUTO if given else pycolmap.CameraMode.SINGLE
    if given:
        _enter_given(job)
    else:
        reader.camera_model = job["camera"]
    for names in job["groups"]:
        # Import the photos first, in order: threads would number them in the order in which they happen to finish.
        if not given:
            pycolmap.import_images(job["database"], job["images"], mode, names, reader)
        pycolmap.extract_features(job["database"], job["images"], names, mode, reader, options, _device(job))


def matching(job: dict[str, Any]) -> None:
    """Match and verify pairs of photos; skip pairs that the database already has."""
    _assume_focal_lengths(job["database"])
    match = {"exhaustive": pycolmap.match_exhaustive, "sequential": pycolmap.match_sequential}[job["matcher"]]
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    match(job["database"], verification_options=verification, device=_device(job))


def _assume_focal_lengths(path: str) -> None:
    """Give fisheyes whose photos tell no focal length one to begin with: pycolmap verifies no pair without."""
    database = pycolmap.Database.open(path)
    for camera in database.read_all_cameras():
        if camera.is_perspective_fisheye() and not camera.has_prior_focal_length:
            params = camera.params
            params[camera.focal_length_idxs()] = max(camera.width, camera.height) / FISHEYE_ANGLE
            camera.params, camera.has_prior_focal_length = params, True
            database.update_camera(camera)
    database.close()


def mapping(job: dict[str, Any]) -> None:
    """Compute poses and points; write one or more models into sub-folders of `models`."""
    os.makedirs(job["models"])
    if job["mapper"] == "global":
        # Global mapping needs initial focal lengths; this estimates them from the pairs.
        calibration = pycolmap.ViewGraphCalibrationOptions()
        calibration.random_seed = SEED
        pycolmap.calibrate_view_graph(job["database"], calibration)
        options = pycolmap.GlobalPipelineOptions()
        options.random_seed, options.num_threads = SEED, THREADS
        pycolmap.global_mapping(job["database"], job["images"], job["models"], options)
        return
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = SEED, THREADS
    options.ba_global_function_tolerance = job["tolerance"]
    options.min_model_size = 3  # a small model is better than none; the report shows its size
    pycolmap.incremental_mapping(job["database"], job["images"], job["models"], options)


def triangulation(job: dict[str, Any]) -> None:
    """Compute points, with their tracks, at the poses and with the lenses that are given, which stay as they are."""
    folder = Path(job["models"], "0")
    folder.mkdir(parents=True)
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = SEED, THREADS
    pycolmap.triangulate_points(
        _given(job["given"]), job["database"], job["images"], str(folder), True, options, refine_intrinsics=False
    )


def _given(path: str) -> pycolmap.Reconstruction:
    """The cameras and photos of given.json as a model without points, with ids in the order of the file."""
    content, model = json.loads(Path(path).read_text(encoding="utf-8")), pycolmap.Reconstruction()
    for number, entry in enumerate(content["cameras"], start=1):
        size = {"width": entry["width"], "height": entry["height"]}
        camera = pycolmap.Camera(model=entry["model"], params=entry["params"], camera_id=number, **size)
        camera.rescale(*entry["size"])
        camera.has_prior_focal_length = True
        model.add_camera_with_trivial_rig(camera)
    for number, entry in enumerate(content["images"], start=1):
        image = pycolmap.Image(name=entry["name"], camera_id=entry["camera"], image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.array(entry["pose"])))
    return model


def _enter_given(job: dict[str, Any]) -> None:
    """Write the cameras and photos of given.json into the database, with the same ids."""
    model, database = _given(job["given"]), pycolmap.Database.open(job["database"])
    for number, camera in model.cameras.items():
        database.write_camera(camera, use_camera_id=True)
        database.write_rig(model.rigs[number], use_rig_id=True)
    for number, image in sorted(model.images.items()):
        database.write_frame(model.frames[number], use_frame_id=True)
        database.write_image(image, use_image_id=True)
    database.close()


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
                "cameras": [
                    {"id": i, "model": c.model_name, "size": [c.width, c.height], "params": c.params.tolist()}
                    for i, c in sorted(model.cameras.items())
                ],
            }
        )
    Path(job["out"]).write_text(json.dumps(models), encoding="utf-8")


def undistort(job: dict[str, Any]) -> None:
    """Write photos and model in COLMAP's layout into the folder `out`: as they are if `native`, else undistorted."""
    if job["native"]:
        model, out = pycolmap.Reconstruction(job["model"]), Path(job["out"])
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


STEPS = {step.__name__: step for step in (features, matching, mapping, triangulation, survey, undistort)}


def main(path: str) -> None:
    """Run the job of a file."""
    job = json.loads(Path(path).read_text(encoding="utf-8"))
    threading.Thread(target=_end_with_input, daemon=True).start()
    pycolmap.set_random_seed(SEED)
    STEPS[job["step"]](job)


if __name__ == "__main__":
    main(sys.argv[1])
