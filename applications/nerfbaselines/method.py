"""The method of NerfBaselines: trains by our loop, one iteration of the schedule at a time, and renders."""

import shutil
import tempfile
import weakref
from collections.abc import Mapping
from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfbaselines import Method

from applications.nerfbaselines.datasets import has_white_background, in_place_of_files, scene_of, view_of
from arguments import write_cfg_args, write_model_json
from arguments.features import FEATURES, appearances
from gaussian_renderer.scored_views import ScoredViews
from groundwork.files.json_files import read_json, write_json
from scene.cameras import Camera
from scene.gaussians.checkpoint import save_checkpoint
from scene.readers.start_cloud import StartOptions
from scene.saved_model import find_save, read_model
from splatting.commands.train import parse
from splatting.iteration import Iteration
from splatting.loop import training_steps
from splatting.make_run import make_run
from splatting.part import Part
from splatting.records import training_log
from splatting.registry import PARTS
from splatting.run import Run
from splatting.watch import MaskWatch
from utils.system_utils import UserError, compute_device, saved_ply

RECORD = "nerfbaselines.json"  # in a checkpoint: its step, and the options that were given
INTERVAL = 100  # iterations between losses that are told: reading one waits for the GPU
# Test views are held out by NerfBaselines. Full-size photos, no viewer, and nothing written but by `save`.
_ALWAYS = ("--eval", "--resolution=1", "--disable_viewer", "--no_curve", "--test_iterations=-1", "--save_iterations=-1")
_OF_FILES = ("appearance", "init_ply", "masks", *(kind.flag for kind in appearances() if kind.flag))
_OF_FILES += tuple(part.name for part in PARTS if part.needs.files)
# Options that nothing follows here, with the value that is the case. Our other observers score, save and show.
_FIXED = dict.fromkeys(
    ("advise", "detect_anomaly",
     "start_checkpoint", "source_path", "model_path", "images", "invert_masks", "keep_unseen", "prune_sh",
     *(name for one in ("resume", "remote_viewer", "viewer") for name in FEATURES[one].by_name))
    , "",
) | {"options": "given", "resolution": "1", "mask_meaning": "auto", "disable_viewer": "true",
     "holdout": "every8"}  # fmt: skip
_LISTS = ("test_iterations", "save_iterations", "checkpoint_iterations")


def words_of(options: Mapping[str, Any]) -> list[str]:
    """Options of train.py, by name, as words of its command line.

    UserError for those that need files of the scene, and for those that would have no effect.
    """
    words = []
    for name, value in options.items():
        if name in (*_FIXED, *_LISTS) and str(value).lower() not in ("false", "none", "", "0", _FIXED.get(name, "-1")):
            raise UserError(f"--{name} {value} has no effect in NerfBaselines, which scores and saves; leave it out")
        if name in _OF_FILES:
            raise UserError(f"--{name} needs the scene's files, and NerfBaselines gives photos in memory; leave it out")
        if str(value).lower() not in ("true", "false"):
            words.append(f"--{name}={value}")
        elif str(value).lower() == "true":
            words.append(f"--{name}")
    return words


class _Losses(Part):
    """Lets the losses be read at intervals."""

    def due(self, at: Iteration) -> bool:
        at.due |= at.last or at.iteration % INTERVAL == 0
        return False  # nobody reads the model


class GaussianSplatting(Method):
    """A training that NerfBaselines steps, or a model that it has loaded from a checkpoint.

    A step is one of the schedule of --iterations. Where seconds are given, an iteration stands for several steps, or a
    step for several iterations, as the clock has it; seconds between steps do not count.
    checkpoint: a folder that `save` has written. config_overrides: options of train.py.
    """

    def __init__(
        self,
        *,
        checkpoint: str | None = None,
        train_dataset: Mapping[str, Any] | None = None,
        config_overrides: Mapping[str, Any] | None = None,
    ) -> None:
        """Start or resume a training, or load a model if there is nothing to train.

        train_dataset: NerfBaselines' data set; None: only render.
        """
        before = read_json(Path(checkpoint) / RECORD) if checkpoint else {"step": 0, "options": {}}
        self._given = before["options"] | dict(config_overrides or {})
        if train_dataset is not None and has_white_background(train_dataset):
            self._given.setdefault("white_background", True)
        self._checkpoint, self._loaded, self._step = checkpoint, before["step"] if checkpoint else None, before["step"]
        self._launch, *self._options = parse([*words_of(self._given), *_ALWAYS])
        self._run: Run | None = None
        self._at: Iteration | None = None
        if train_dataset is not None and self._step < self._options[1].iterations:
            self._begin_training(train_dataset)
            self._gaussians = self._run.gaussians
        else:
            self._gaussians = read_model(find_save(checkpoint, -1)[1])
        white = torch.full((3,), float(self._options[0].white_background), device=compute_device())
        self._views = ScoredViews(self._options[2], white, False)

    def _begin_training(self, dataset: Mapping[str, Any]) -> None:
        """Start a training, or resume that of the checkpoint."""
        folder = Path(tempfile.mkdtemp(prefix="gaussian-splatting-"))
        self._removal = weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        model, launch = self._options[0], self._launch
        model.model_path = str(folder / "model")
        if self._checkpoint:
            launch.start_checkpoint = str(next(Path(self._checkpoint).glob("chkpnt*.pth")))
        info = scene_of(dataset, StartOptions(model.init_pcd_path, model.init_type))
        with in_place_of_files(info, folder / "scene") as model.source_path:
            self._run = run = make_run(*self._options, launch)
        run.open()
        guards = [run.watch, MaskWatch(run.scene.getTrainCameras()), _Losses()]
        self._steps = training_steps(run, guards)
        self._pause = ExitStack()
        for opened in (self._pause, self._steps):  # neither can be closed any more once Python is being torn down
            weakref.finalize(self, opened.close)
        self._pause.enter_context(run.clock.paused("between steps"))

    @classmethod
    def get_method_info(cls) -> dict[str, Any]:
        """Return what NerfBaselines has to know before it loads a dataset."""
        return {
            "method_id": "",
            "required_features": frozenset(("color", "points3D_xyz", "points3D_rgb")),
            "supported_camera_models": frozenset(("pinhole", "opencv", "opencv_fisheye", "full_opencv")),
            "supported_outputs": ("color",),
            "can_resume_training": True,
            "viewer_default_resolution": 768,
        }

    def get_info(self) -> dict[str, Any]:
        """Return `get_method_info` with steps and options added."""
        model, opt, pipe = map(vars, self._options)
        options = vars(self._run.options) if self._run else model | opt | pipe
        return self.get_method_info() | {
            "num_iterations": self._options[1].iterations,
            "loaded_step": self._loaded,
            "loaded_checkpoint": self._checkpoint,
            "batch_size": 1,
            "hparams": {k: v for k, v in options.items() if k not in ("source_path", "model_path")},
        }

    def train_iteration(self, step: int) -> dict[str, float]:
        """Take the iterations up to a step, counted from 0. Every INTERVAL iterations, returns the mean loss."""
        told: dict[str, float] = {}
        if self._run is None:
            return told
        self._pause.close()
        try:
            while self._step <= step and (taken := next(self._steps, None)):
                self._at, self._taker = taken
                self._step = self._at.span.stop - 1
                if self._at.due:
                    told = {"loss": self._run.losses.mean, "num_gaussians": self._gaussians.gaussian_count}
                if self._at.last:
                    next(self._steps, None)
        except UserError:
            self._removal.detach()  # the message may name a checkpoint there
            raise
        self._pause.enter_context(self._run.clock.paused("between steps"))
        return told

    def _view_model(self) -> Any:
        """Make a context in which the model is the one after the last step."""
        if self._run is None:
            return nullcontext()
        if self._at is not None:
            self._taker.drain()
            self._run.watch.check(self._at.iteration)
        return self._run.flushed_view()

    @torch.no_grad()
    def render(self, camera: Any, *, options: Mapping[str, Any] | None = None) -> dict[str, np.ndarray]:
        """One view of NerfBaselines: color, (H, W, 3) float32 in [0, 1]."""
        view = view_of(camera.item())
        with self._view_model():
            image = self._views.whole(Camera(view, (view.width, view.height), 0), self._gaussians)
        return {"color": image.permute(1, 2, 0).cpu().numpy()}

    def save(self, path: str) -> None:
        """Write a model folder with checkpoint and PLY, from which to render and to train on."""
        folder, run = Path(path), self._run
        if run is None:
            shutil.copytree(self._checkpoint, folder, dirs_exist_ok=True)
            return
        iteration = self._at.iteration if self._at else run.first_iteration
        options = run.options
        options.source_path = options.model_path = ""  # they lie in a temporary folder
        folder.mkdir(parents=True, exist_ok=True)
        with self._view_model():
            save_checkpoint(folder / f"chkpnt{iteration}.pth", run.checkpoint_state(), iteration)
            self._gaussians.save_ply(str(saved_ply(folder, iteration)))
        run.log.add(iteration, run.clock.seconds, gaussians=self._gaussians.gaussian_count, loss=run.losses.mean)
        shutil.copyfile(Path(run.scene.model_path) / training_log.NAME, folder / training_log.NAME)
        write_cfg_args(folder, options)
        write_model_json(folder, options, **run.entries)
        write_json(folder / RECORD, {"step": self._step, "options": self._given})
