"""Exports in the upright frame of a model's similarity: splats, cameras and paths under it."""

import argparse
import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gaussian_renderer.camera_paths.keyframes import Keyframe, TimedPath
from gaussian_renderer.camera_paths.poses import keyframe, poses_of
from groundwork.files.json_files import read_model_json
from groundwork.files.similarity import ENTRY, Similarity, local_similarity, recorded_similarity
from scene.cameras import Camera
from scene.splats.splats import Splats, rotated
from utils.system_utils import UserError


def add_upright_options(add: Callable[..., Any]) -> None:
    """Add options to those of export.py."""
    add("--upright", action="store_true",
        help="turn and scale as convert.py --orient found (default: on for pages, meshes and levels)")  # fmt: skip
    add(
        "--no_upright",
        action="store_true",
        help="keep pages, meshes and levels in the scene's frame (default: off)",
    )


def check_upright(args: argparse.Namespace) -> None:
    """UserError for --upright of a model that does not say where it is upright, or beside its contrary."""
    if args.upright and args.no_upright:
        raise UserError("--upright and --no_upright contradict each other; leave one out")
    if not args.upright:
        return
    if (record := recorded_similarity(args.model_path, args.source_path).get(ENTRY)) is None:
        raise UserError(
            "--upright needs a model folder (-m) of a scene that was oriented; run convert.py --orient on it, or leave "
            "--upright out"
        )
    if not Similarity.read(record, f"orientation of {args.model_path}").upright:
        raise UserError("--upright: convert.py --orient found no vertical of this scene; leave --upright out")


def follows_scene(args: argparse.Namespace) -> bool:
    """Tell if --upright takes the orientation from the scene; it does not fit a model of other poses."""
    return args.upright and ENTRY not in read_model_json(args.model_path)


def move_upright(args: argparse.Namespace, of_scene: bool, splats: Splats, around: Any) -> tuple[Splats, Any]:
    """Move the splats, and the `SceneInputs` of a page or mesh, into the frame that the options ask for.

    args: options that have passed `check_upright`.
    of_scene: the format takes `SceneInputs`.
    """
    local = None
    if not args.no_upright and (args.upright or of_scene):
        local = local_similarity(args.model_path, args.source_path)
    if local is None:
        return splats, around
    return move_splats(splats, local), move_inputs(around, local) if around else around


def move_splats(splats: Splats, similarity: Similarity) -> Splats:
    """Move Gaussians by a similarity of their frame; the result has no offset.

    Directions turn with the world, so SH bands do; a larger scale needs no enlargement where they are drawn.
    """
    enlargement = 2.0 ** np.ceil(np.log2(splats.enlargement / similarity.scale))
    return replace(
        rotated(splats, similarity.rotation),
        means=similarity.transform(splats.means).astype(np.float32),
        log_scales=splats.log_scales + np.float32(np.log(similarity.scale)),
        enlargement=max(1.0, float(enlargement)),
        place=similarity.place,
    )


def move_cameras(cameras: Sequence[Camera], similarity: Similarity) -> list[Camera]:
    """Copy cameras, and move them so that they see the moved splats as before."""
    poses = poses_of(cameras)
    places, turns = similarity.transform(poses.positions), similarity.rotation @ poses.turns
    twins = [copy.copy(camera) for camera in cameras]
    for twin, place, turn in zip(twins, places, turns, strict=True):
        twin.place(turn, -turn.T @ place)
    return twins


@dataclass(frozen=True)
class MovedPath:
    """A camera path under a similarity."""

    path: TimedPath
    similarity: Similarity

    @property
    def seconds(self) -> float:
        return self.path.seconds

    @property
    def closed(self) -> bool:
        return self.path.closed

    def at(self, seconds: float) -> Keyframe:
        """The pose at a moment."""
        from scipy.spatial.transform import Rotation

        key = self.path.at(seconds)
        place = self.similarity.transform(np.array([key.position]))[0]
        turn = self.similarity.rotation @ Rotation.from_quat(key.wxyz, scalar_first=True).as_matrix()
        return keyframe(key.seconds, place, turn, key.fov)


def move_inputs(around: Any, similarity: Similarity) -> Any:
    """Return `SceneInputs` (applications/export/formats.py) with its cameras and paths moved by a similarity.

    A path is made in the model's own frame, in which files of keyframes are, and then moved.
    """
    cameras, make = around.cameras, around.make_path
    if not cameras:
        return around
    make_moved = make and (lambda _: MovedPath(make(poses_of(cameras)), similarity))
    moved = {"cameras": move_cameras(cameras, similarity), "make_path": make_moved}
    return around._replace(**moved, upright=similarity.upright, metric=similarity.metric)
