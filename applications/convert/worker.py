"""pycolmap's long steps in their own process: `python worker.py JOB.json`, a file with {"step": ..., ...}.

In another process, steps can be stopped at once, log to a file, and do not crash the caller when they crash. The worker
ends when its standard input closes, so it does not outlive a caller that was killed. Of the project it imports only
modules that need no torch.

A pair is two photos whose matches passed the geometric check. A survey is a file on what the mapper's models contain.
"""

import contextlib
import json
import os
import shutil
import sqlite3
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from applications.convert import pairing
from applications.convert.database import opened
from applications.convert.global_sfm.pairs import pose_pairs
from applications.convert.reduced import ABOUT, ENLARGED, FEW, choose_longest_side, read_enlarged, reduce_photos
from scene.agreement import judge

SEED = 0
DENSE = 1000  # matches of a photo, verified
TRACKS = 100  # points of a photo that global mapping solves for where there are more; all are triangulated afterwards
FEWEST_SEEN = 50  # points of a photo that tell its focal length
MOST_SEEN = 400  # that are asked: more take longer and tell no more
_JUDGED = 3  # models; others are far smaller
_NEIGHBOURS, _SHOWN = 30, 5000  # other photos of a photo, and points, in capture.json
# Of mapping, -1: all cores. Several add numbers in the order in which they happen to finish, so one repeats bytes.
THREADS = 1 if os.environ.get("OMP_NUM_THREADS") == "1" else -1
FISHEYE_ANGLE = 2.6  # radians along the longer side, 150 degrees: first guess for a fisheye


def features(job: dict[str, Any]) -> None:
    """Write SIFT features of groups of photos into a database, with one camera per group, or with given cameras.

    Photos that the database has already stay; new photos of their group get the same camera.
    """
    reader = pycolmap.ImageReaderOptions()
    if job["masks"]:
        reader.mask_path = job["masks"]
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = job["max_num_features"]
    opened(job["database"]).close()
    # Masks and given cameras belong to the photos as they are.
    images = job["images"] if job["masks"] or job["mapper"] == "triangulation" else job["small"]
    if job["mapper"] == "triangulation":
        _enter_given(job)
    else:
        reader.camera_model = job["camera"]
        # Import the photos first, in order: threads would number them in the order in which they happen to finish. The
        # camera of a group begins with the focal length that the EXIF data of its first photo tell, if they do.
        known = _read_cameras(Path(job["base"]).with_name("database.db")) if job["mapper"] == "adding" else {}
        longest = choose_longest_side(sum(map(len, job["groups"])))
        for names in job["groups"]:
            reader.existing_camera_id = next((known[name][0] for name in names if name in known), -1)
            if new := [name for name in names if name not in known]:
                if images != job["images"]:
                    size = next((known[name][1] for name in names if name in known), None)
                    reduce_photos(Path(job["images"]), Path(images), new, longest, size)
                pycolmap.import_images(job["database"], images, pycolmap.CameraMode.SINGLE, new, reader)
    _refuse_strangers(job)
    for octave, names in _group_by_octave(job["database"]).items():
        options.sift.first_octave = octave
        pycolmap.extract_features(
            job["database"], images, names, pycolmap.CameraMode.AUTO, reader, options, _choose_device(job)
        )


def _refuse_strangers(job: dict[str, Any]) -> None:
    """End the program if COLMAP did not take all photos: it leaves out those of another size than their camera."""
    database = opened(job["database"])
    known = {image.name for image in database.read_all_images()}
    database.close()
    if missing := [name for names in job["groups"] for name in names if name not in known]:
        sys.exit(
            f"{len(missing)} photos, such as {missing[0]}, have another size than the camera that they would share; "
            "give them a sub-folder of their own, or omit --mask_path if the photos before had no masks"
        )


def _group_by_octave(database_path: str) -> dict[int, list[str]]:
    """Return the photos' names by SIFT's first octave: -1 for small photos, which SIFT enlarges twofold, else 0."""
    database = opened(database_path)
    images, sizes = database.read_all_images(), {one.camera_id: one for one in database.read_all_cameras()}
    database.close()
    longest = ABOUT * max(choose_longest_side(len(images)), ENLARGED)
    found: dict[int, list[str]] = {}
    for image in images:
        camera = sizes[image.camera_id]
        found.setdefault(-1 if 2 * max(camera.width, camera.height) <= longest else 0, []).append(image.name)
    return found


def _read_cameras(database_path: Path) -> dict[str, tuple[int, tuple[int, int]]]:
    """Read camera id and (width, height) in pixels of each photo of a database, by the photo's name."""
    connection = sqlite3.connect(f"{database_path.absolute().as_uri()}?mode=ro", uri=True)
    with contextlib.closing(connection):
        rows = connection.execute("SELECT name, camera_id, width, height FROM images JOIN cameras USING (camera_id)")
        return {name: (camera, (width, height)) for name, camera, width, height in rows}


def matching(job: dict[str, Any]) -> None:
    """Match and verify pairs of photos; skip pairs that the database already has."""
    database_path = job["database"]
    pairing.restore_names(database_path)
    _assume_focal_lengths(database_path)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    how = {"verification_options": verification, "device": _choose_device(job)}
    if job["matcher"] == "auto":
        for pairs in pairing.plan_rounds(database_path, job["all_of"]):
            pairing.match_pairs(database_path, pairs, Path(database_path).with_name("pairs.txt"), **how)
        return
    match = {"exhaustive": pycolmap.match_exhaustive, "sequential": pycolmap.match_sequential}[job["matcher"]]
    match(database_path, **how)


def _assume_focal_lengths(database_path: str) -> None:
    """Give fisheyes whose photos tell no focal length one to begin with: pycolmap verifies no pair without."""
    database = opened(database_path)
    for camera in database.read_all_cameras():
        if camera.is_perspective_fisheye() and not camera.has_prior_focal_length:
            params = camera.params
            params[camera.focal_length_idxs()] = max(camera.width, camera.height) / FISHEYE_ANGLE
            camera.params, camera.has_prior_focal_length = params, True
            database.update_camera(camera)
    database.close()


def calibrate(job: dict[str, Any]) -> None:
    """Estimate focal lengths from pairs, where photos do not tell them, and write them and the pairs' poses."""
    options = pycolmap.ViewGraphCalibrationOptions()
    options.random_seed, options.reestimate_relative_pose = SEED, False
    pycolmap.calibrate_view_graph(job["calibrated"], options)
    pose_pairs(job["calibrated"])


def mapping(job: dict[str, Any]) -> None:
    """Compute poses and points in the way `mapper`; write one or more models into sub-folders of `models`.

    All but free begin with the focal lengths of `calibrate`. direct is that of global_sfm. grown is incremental, from
    the model `base` without the photos `left_out`.
    """
    os.makedirs(job["models"])
    way, photos = job["mapper"], _choose_photo_folder(job)
    database = job["database" if way == "free" else "calibrated"]
    if way == "direct":
        from applications.convert.global_sfm.mapper import map_globally  # with SciPy, which no other step needs

        for number, model in enumerate(map_globally(job["database"], database, photos, THREADS)):
            folder = Path(job["models"], str(number))
            folder.mkdir()
            model.write(str(folder))
        return
    if way == "global":
        options = pycolmap.GlobalPipelineOptions()
        options.random_seed, options.num_threads = SEED, THREADS
        if _is_dense(database):
            options.mapper.track_required_tracks_per_view = TRACKS
        pycolmap.global_mapping(database, photos, job["models"], options)
        return
    options = _make_incremental_options(job)
    options.min_model_size = 3  # a small model is better than none; the report shows its size
    if way != "grown":
        pycolmap.incremental_mapping(database, photos, job["models"], options)
        return
    options.multiple_models = False
    folder = Path(job["models"], "0")
    folder.mkdir()
    with tempfile.TemporaryDirectory(dir=folder.parents[1]) as sound:  # the whole model may still be chosen
        _leave_out(job["base"], job["left_out"]).write(sound)
        pycolmap.incremental_mapping(database, photos, str(folder), options, sound)


def _choose_photo_folder(job: dict[str, Any]) -> str:
    """The folder of the photos in which features were found, from which points take their colours."""
    return job["small"] if Path(job["small"]).is_dir() else job["images"]


def _is_dense(database_path: str) -> bool:
    """Tell if a database has many photos with so many matches that a part of the matches is enough for mapping."""
    database = opened(database_path)
    count, matches = database.num_images(), database.num_inlier_matches()
    database.close()
    return count > FEW and matches > DENSE * count


def keep(job: dict[str, Any]) -> None:
    """Take the photos `left_out` out of the model in the folder `model`."""
    _leave_out(job["model"], job["left_out"]).write(job["model"])


def _leave_out(folder: str, names: Sequence[str]) -> pycolmap.Reconstruction:
    """Read a model without the poses of some photos, which may have none."""
    model = pycolmap.Reconstruction(folder)
    for name in names:
        image = model.find_image_with_name(name)
        if image and image.has_pose:
            model.deregister_frame(image.frame_id)
    return model


def _make_incremental_options(job: dict[str, Any]) -> pycolmap.IncrementalPipelineOptions:
    """Make options of incremental mapping with the tolerance of the job and a fixed seed."""
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = SEED, THREADS
    options.ba_global_function_tolerance = job["tolerance"]
    return options


def adding(job: dict[str, Any]) -> None:
    """Place further photos beside those of the model `base`, whose poses and lenses stay as they are."""
    folder, options = Path(job["models"], "0"), _make_incremental_options(job)
    folder.mkdir(parents=True)
    options.multiple_models, options.fix_existing_frames = False, True
    options.constant_cameras = set(pycolmap.Reconstruction(job["base"]).cameras)
    pycolmap.incremental_mapping(job["database"], _choose_photo_folder(job), str(folder), options, job["base"])


def triangulation(job: dict[str, Any]) -> None:
    """Compute points, with their tracks, at the poses and with the lenses that are given, which stay as they are."""
    folder = Path(job["models"], "0")
    folder.mkdir(parents=True)
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = SEED, THREADS
    pycolmap.triangulate_points(
        _read_given(job["given"]), job["database"], job["images"], str(folder), True, options, refine_intrinsics=False
    )


def _read_given(path: str) -> pycolmap.Reconstruction:
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
    model, database = _read_given(job["given"]), opened(job["database"])
    for number, camera in model.cameras.items():
        database.write_camera(camera, use_camera_id=True)
        database.write_rig(model.rigs[number], use_rig_id=True)
    for number, image in sorted(model.images.items()):
        database.write_frame(model.frames[number], use_frame_id=True)
        database.write_image(image, use_image_id=True)
    database.close()


def judging(job: dict[str, Any]) -> None:
    """Judge the largest models in `models` by the pairs of `calibrated`, and write the best one's folder to `out`.

    The JSON file has the folder, the number of its photos, and what the judgement found.
    """
    found = [
        {"folder": folder, "photos": model.num_reg_images()} | judge(model, job["calibrated"])
        for folder, model in _read_models(job["models"])[:_JUDGED]
    ]
    best = max(found, key=lambda one: (one["agreeing"], one["photos"]), default={})
    Path(job["out"]).write_text(json.dumps(best), encoding="utf-8")


def survey(job: dict[str, Any]) -> None:
    """Write the contents of the models to the JSON file `out`."""
    models = [
        {
            "folder": folder,
            "registered": sorted(model.images[i].name for i in model.reg_image_ids()),
            "points": model.num_points3D(),
            "track_length": model.compute_mean_track_length(),
            "error": model.compute_mean_reprojection_error(),
            "cameras": [_describe_camera(model, camera) for _, camera in sorted(model.cameras.items())],
        }
        for folder, model in _read_models(job["models"], Path(job["images"]))
    ]
    Path(job["out"]).write_text(json.dumps(models), encoding="utf-8")


def _read_models(path: str, photos: Path | None = None) -> list[tuple[str, pycolmap.Reconstruction]]:
    """The models in the sub-folders of a folder, by name, the one with the most photos first.

    photos: folder of the photos to whose size they are brought; None: they stay as they are.
    """
    found = []
    for folder in sorted(Path(path).iterdir()):
        try:
            model = read_enlarged(str(folder), photos) if photos else pycolmap.Reconstruction(str(folder))
            found.append((folder.name, model))
        except (ValueError, RuntimeError, IndexError):
            continue  # no model, or one whose writing was interrupted
    return sorted(found, key=lambda one: (-one[1].num_reg_images(), -one[1].num_points3D(), one[0]))


def _describe_camera(model: pycolmap.Reconstruction, camera: pycolmap.Camera) -> dict[str, Any]:
    """Describe a camera of a model: id, lens model, size in pixels, params, and its photos.

    photos: by name, the result of `_probe_focal_length`.
    """
    images = [model.images[i] for i in model.reg_image_ids() if model.images[i].camera_id == camera.camera_id]
    return {
        "id": camera.camera_id,
        "model": camera.model_name,
        "size": [camera.width, camera.height],
        "params": camera.params.tolist(),
        "photos": {image.name: _probe_focal_length(model, image) for image in sorted(images, key=lambda one: one.name)},
    }


def _probe_focal_length(model: pycolmap.Reconstruction, image: pycolmap.Image) -> list[float]:
    """Fit focal length and pose of a single photo to its points, to see if it came through another lens.

    The model stays as it is: the fit works on copies. A photo of another lens than that of its camera fits much better.
    Return the fitted focal length divided by the model's, and the median error in pixels before and after the fit; []
    if too few points tell the focal length.
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


def _write_capture(model: pycolmap.Reconstruction, path: str) -> None:
    """Write where the photos of a model stand, and which points they share, to a JSON file."""
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
    Path(path).write_text(json.dumps(content), encoding="utf-8")


def undistort(job: dict[str, Any]) -> None:
    """Write photos and model in COLMAP's layout into the folder `out`: as they are if `native`, else undistorted.

    capture: of _write_capture.
    """
    model, out = read_enlarged(job["model"], Path(job["images"])), Path(job["out"])
    _write_capture(model, job["capture"])
    if job["native"]:
        for name in [model.images[i].name for i in model.reg_image_ids()]:
            (out / "images" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(Path(job["images"], name), out / "images" / name)
        (out / "sparse").mkdir()
        model.write(str(out / "sparse"))
        return
    with tempfile.TemporaryDirectory(dir=out.parent) as folder:
        model.write(folder)
        pycolmap.undistort_images(job["out"], folder, job["images"], jpeg_quality=job["jpeg_quality"])


def _choose_device(job: dict[str, Any]) -> pycolmap.Device:
    """Choose the CPU if the job forbids the GPU, else whatever pycolmap finds."""
    return pycolmap.Device.cpu if job["no_gpu"] else pycolmap.Device.auto


def _end_with_input() -> None:
    """End this process when its standard input closes, as it does once the caller has ended."""
    # Do not read sys.stdin: its lock would be held when the interpreter shuts down.
    while os.read(0, 1024):
        pass
    os._exit(1)


STEPS = {
    step.__name__: step
    for step in (features, matching, calibrate, mapping, adding, triangulation, judging, keep, survey, undistort)
}


def main(path: str) -> None:
    """Run the job of a file."""
    job = json.loads(Path(path).read_text(encoding="utf-8"))
    threading.Thread(target=_end_with_input, daemon=True).start()
    pycolmap.set_random_seed(SEED)
    STEPS[job["step"]](job)


if __name__ == "__main__":
    main(sys.argv[1])
