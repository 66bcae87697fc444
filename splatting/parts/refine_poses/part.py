"""Poses that are trained with the Gaussians (--refine_poses): a small correction of each training camera's."""

import copy
from typing import TYPE_CHECKING, Any

from splatting.files.json_files import MODEL_JSON
from splatting.option import Option
from splatting.part import Needs, Options, Part, Scored, fill
from utils.system_utils import UserError

if TYPE_CHECKING:
    import argparse

    from scene.readers.info import SceneInfo
    from scene.scene import Scene


class RefinePoses(Part):
    """Gives the cameras their poses, which take steps on the host, and keeps them in poses.json."""

    name = "refine_poses"
    tools = "advise", "for_wrong_poses"
    # fmt: off
    options = Options(model=(
        Option("refine_poses", False, origin="ours", stored=MODEL_JSON, topic="cameras",
            help="correct the pose of each training camera together with the Gaussians, by at most 3 degrees; needs "
                 "the tracks of a COLMAP scene"),
    ))
    # fmt: on
    needs = Needs(files=True)
    against = {"projection=ray": "which has no gradients of poses; leave one of them out"}

    @classmethod
    def dropped(cls, given: "argparse.Namespace", iteration: int) -> str | None:
        raise UserError(f"{given.start_checkpoint} was trained with --{cls.name}; give that option")

    def dataset(self, info: "SceneInfo", args: "argparse.Namespace", fresh: bool) -> "SceneInfo":
        from splatting.parts.refine_poses.pose_file import with_poses

        self._elsewhere = bool(getattr(args, "other_scene", ""))
        return info if fresh or self._elsewhere else with_poses(info, args.model_path)

    def begin(self, run: Any, state: Any) -> None:
        from splatting.parts.refine_poses.refinement import PoseRefinement

        self.poses = PoseRefinement(run.scene, run.dataset.source_path, run.opt.iterations)
        if run.start:
            self.poses.restore(state)
        fill(run, "on_host", self.poses, self)

    def ready(self, run: Any) -> None:
        """Only now cameras leave where they were when a new training began, as other parts have measured them."""
        self.poses.place()

    def records(self) -> dict[str, float]:
        return self.poses.corrections()

    def state(self) -> dict[str, Any]:
        return self.poses.captured()

    def scored(self, scene: "Scene", pipe: "argparse.Namespace", background: Any) -> dict[str, Scored]:
        """Test views as the dataset has them."""
        from splatting.evaluation.comparison import GIVEN_POSES

        views = [] if self._elsewhere else [copy.copy(camera) for camera in scene.getTestCameras()]
        for camera in views:
            given = scene.given_test_views[camera.uid]
            camera.place(given.R, given.T)
        return {GIVEN_POSES: (None, views)} if views else {}

    def save(self, scene: "Scene") -> None:
        from splatting.parts.refine_poses.pose_file import write_poses

        write_poses(scene.model_path, scene.getTrainCameras(), scene.getTestCameras())
