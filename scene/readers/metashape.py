"""Cameras of Agisoft Metashape (File > Export > Export Cameras, Agisoft XML), as the content of a transforms.json.

The formulas of its camera model are in an appendix of its manual: with x, y of a direction and r its distance from the
axis, x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p1 (r^2 + 2 x^2) + 2 p2 x y, and likewise for y with p1 and p2
exchanged; then u = w/2 + cx + x f + x b1 + y b2, v = h/2 + cy + y f. So its p1 is OpenCV's p2. A fisheye first scales
the direction so that r is the angle.

Of a rig, only the master camera has a pose. The others name it, and their sensors have a rotation and a location in the
frame of the master's sensor, in the unit of the chunk.
"""

import os
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np

from groundwork.files.image_files import SUFFIXES
from groundwork.files.plain_files import MOST, plain_path
from groundwork.files.unread import note_unread
from groundwork.host.listing import some
from scene.images.find import FileIndex
from scene.images.lens import PANORAMA
from utils.system_utils import UserError

_HEAD = 1024  # bytes in which the file says what it is
_MODELS = {"frame": "OPENCV", "fisheye": "OPENCV_FISHEYE", "spherical": PANORAMA}
_USED = {"OPENCV": ("k1", "k2", "k3", "p1", "p2"), "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4")}
_LENS = ("f", "cx", "cy", "b1", "k1", "k2", "k3")
_REFUSED = ("k4", "p1", "p2", "p3", "p4", "b2")  # where the model has no place for them
_LARGEST = 1e9  # scale of a chunk, which has the metres of its unit
_READ = {"sensors", "components", "cameras", "sensor", "component", "camera", "calibration", "transform"}
_READ |= {"resolution", "rotation", *(_PLACE := ("location", "translation")), *_LENS, *_REFUSED}
_AS_COLMAP = "export the cameras as Colmap (*.txt), which Metashape 2.2 and later can"


def cameras_xml(folder: Path) -> Path | None:
    """The file of cameras in a folder; None where there is none. UserError where there are several."""
    found = [path for path in sorted(folder.glob("*.xml")) if _is_metashape(path)]
    if len(found) > 1:
        names = some([path.name for path in found])
        raise UserError(f"{folder} has several files of Metashape's cameras: {names}; keep one of them there")
    return found[0] if found else None


def _is_metashape(path: Path) -> bool:
    """Tell whether the head of a file is that of a Metashape export."""
    try:
        with open(plain_path(path), "rb") as file:
            head = file.read(_HEAD)
    except OSError:  # a folder, a pipe, or another user's: the file may be anybody's
        return False
    return b"<document" in head and b"<chunk" in head


def read_metashape(path: Path, images: str) -> dict[str, Any]:
    """The content of a transforms.json. UserError for a broken file, and for a camera model that has no place there.

    images: the folder of the photos beside the file; without it they are looked for below the file's own. A message
    says which cameras have no pose.
    """
    chunk = _read_chunk(path)
    try:
        lenses = {sensor.get("id"): sensor for sensor in chunk.iter("sensor")}
        parts = [part for part in chunk.iter("component") if part.find("transform") is not None]
        to_world = {part.get("id"): _read_similarity(part, path) for part in parts}
        whole, folder = _read_similarity(chunk, path), path.parent / (images or "images")
        folder = folder if folder.is_dir() else path.parent
        index, cameras = FileIndex(folder), list(chunk.find("cameras").iter("camera"))
        by_id, frames, without = {camera.get("id"): camera for camera in cameras}, [], []
        for camera in cameras:
            label, master = str(camera.get("label")), by_id.get(camera.get("master_id"), camera)
            pose = _read_pose(camera, master, lenses)
            if pose is None or camera.get("enabled", "1").lower() in ("0", "false"):
                without.append(label)
                continue
            scale, rotation, shift = to_world.get(camera.get("component_id", master.get("component_id")), whole)
            pose[:3, 3] = scale * rotation @ pose[:3, 3] + shift
            pose[:3, :3] = rotation @ pose[:3, :3] * (1, -1, -1)  # y down and z forward there
            photo, lens = (
                _find_photo(index, label, path) or folder / label,
                _read_lens(lenses[camera.get("sensor_id")], path),
            )
            frames.append({"file_path": os.path.relpath(photo, path.parent), "transform_matrix": pose.tolist(), **lens})
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"the cameras in {path} cannot be read ({type(error).__name__}: {error}); export them again from Metashape"
        ) from error
    if not frames:
        raise UserError(f"{path} has no aligned camera; align the photos in Metashape, and choose Export Cameras")
    if without:
        why = "are not aligned, have no place in their rig, or are not enabled"
        print(f"{len(without)} cameras of {path} {why}: {some(without)}", file=sys.stderr)
    told = [chunk, *cameras, *(part for tag in ("sensor", "component", "calibration") for part in chunk.iter(tag))]
    note_unread(path, "metashape", {part.tag for of in told for part in of} - _READ)
    return {"frames": frames}


def _read_chunk(path: Path) -> ElementTree.Element:
    """Read the only chunk of a Metashape export. UserError for unreadable XML and other numbers of chunks."""
    try:
        if os.path.getsize(plain_path(path)) > MOST:
            raise ValueError(f"it has more than {MOST >> 20} MiB")
        root = ElementTree.parse(path).getroot()
    except (OSError, ValueError, ElementTree.ParseError) as error:
        raise UserError(f"{path} is not readable XML ({error}); export the cameras again from Metashape") from error
    chunks = root.findall("chunk")
    if len(chunks) != 1:
        raise UserError(f"{path} has {len(chunks)} chunks and needs one; choose Export Cameras for one chunk")
    return chunks[0]


def _read_numbers(element: ElementTree.Element, count: int) -> np.ndarray:
    values = np.array((element.text or "").split(), dtype=np.float64)
    if values.size != count:
        raise ValueError(f"{element.tag} has {values.size} numbers and needs {count}")
    return values


def _read_pose(
    camera: ElementTree.Element, master: ElementTree.Element, sensors: dict[str | None, ElementTree.Element]
) -> np.ndarray | None:
    """From the frame of a camera to the chunk's (4,4), if need be by the master camera of its rig; None: unknown."""
    if (place := camera.find("transform")) is not None:
        return _read_numbers(place, 16).reshape(4, 4)
    if (place := master.find("transform")) is None:
        return None
    own, masters = (_read_rig_pose(sensors[part.get("sensor_id")]) for part in (camera, master))
    if own is None or masters is None:
        return None
    return _read_numbers(place, 16).reshape(4, 4) @ np.linalg.inv(masters) @ own


def _read_rig_pose(sensor: ElementTree.Element) -> np.ndarray | None:
    """From the frame of a sensor to that of the rig (4,4), which is the master sensor's; None: unknown."""
    rotation, *places = map(sensor.find, ("rotation", *_PLACE))
    place = next((one for one in places if one is not None), None)
    if rotation is place is None and sensor.get("master_id"):
        return None
    pose = np.eye(4)
    if rotation is not None:
        pose[:3, :3] = _read_numbers(rotation, 9).reshape(3, 3)
    if place is not None:
        pose[:3, 3] = _read_numbers(place, 3)
    return pose


def _read_similarity(part: ElementTree.Element, path: Path) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation (3,3) and shift (3,) from the frame of a chunk or component to the world's.

    UserError for a scale that leaves no scene.
    """
    found = part.find("transform")
    parts = {} if found is None else {child.tag: child for child in found}
    scale = float(_read_numbers(parts["scale"], 1)[0]) if "scale" in parts else 1.0
    if not 1 / _LARGEST <= scale <= _LARGEST:
        raise UserError(
            f"the {part.tag} in {path} has the scale {scale:g}, which no scene has; reset the transform of the chunk "
            "in Metashape, or set its reference again, and export the cameras again"
        )
    rotation = _read_numbers(parts["rotation"], 9).reshape(3, 3) if "rotation" in parts else np.eye(3)
    return scale, rotation, _read_numbers(parts["translation"], 3) if "translation" in parts else np.zeros(3)


def _read_lens(sensor: ElementTree.Element, path: Path) -> dict[str, Any]:
    """The fields of a lens in transforms.json."""
    kind, size = str(sensor.get("type")), sensor.find("resolution")
    if kind not in _MODELS:
        raise UserError(f"{path} has a camera of the unsupported type {kind}; {_AS_COLMAP}")
    width, height = float(size.get("width")), float(size.get("height"))
    fields: dict[str, Any] = {"camera_model": _MODELS[kind], "w": width, "h": height}
    if fields["camera_model"] == PANORAMA:
        return fields
    every = sensor.findall("calibration")
    adjusted = next((found for found in every if found.get("class") == "adjusted"), every[-1] if every else None)
    if adjusted is None:
        raise UserError(f"a camera in {path} has no calibration; align its photos in Metashape, and export again")
    values = {child.tag: float(_read_numbers(child, 1)[0]) for child in adjusted if child.tag in (*_LENS, *_REFUSED)}
    used = _USED[fields["camera_model"]]
    unknown = [name for name in _REFUSED if values.get(name) and name not in used]
    unknown += ["corrections"] * (adjusted.find("corrections") is not None)
    if unknown:
        raise UserError(
            f"{path} has lens parameters that are not supported for cameras of the type {kind}: {', '.join(unknown)}; "
            f"disable them in Optimize Cameras, or {_AS_COLMAP}"
        )
    terms = {name: values.get(name, 0.0) for name in used}
    if "p1" in terms:
        terms["p1"], terms["p2"] = terms["p2"], terms["p1"]
    fields |= {"fl_x": values["f"] + values.get("b1", 0.0), "fl_y": values["f"], **terms}
    return fields | {"cx": width / 2 + values.get("cx", 0.0), "cy": height / 2 + values.get("cy", 0.0)}


def _find_photo(index: FileIndex, label: str, path: Path) -> Path | None:
    """The photo of a label, which is a file's name, mostly without its suffix, in any sub-folder; None without one."""
    names = (label, *(label + suffix for suffix in SUFFIXES))
    photo = index.find(*names)
    below = [] if photo else [file for name in names for file in index.named(name)]
    if len(below) > 1:
        raise UserError(
            f"the photo {label} of {path} may be any of {some(list(map(str, below)))}; name the folder of the "
            f"photos with -i, give them different names and export again, or {_AS_COLMAP}"
        )
    return photo or (below[0] if below else None)
