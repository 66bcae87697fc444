"""The manual of parts. A part is one class, in a file of its own, that adds one feature to a training.

To write a part:

1. Write a subclass of `Part` in splatting/features/NAME.py, called NAME in capital words (depth_tv: DepthTv).
2. Add the class to PARTS in splatting/registry.py. All hooks call the parts in the order of that list.
3. Describe its options, if there are any, by an entry in arguments/features.py.

No other file names the part. Every hook is optional, and a hook that a class does not override costs nothing. Move long
methods into a second file beside the first one, NAME_*.py. Import `arguments`, and all that imports `arguments`, only
inside functions that a training calls: programs of others may have a package of that name, and they load all parts when
they make a scene.

Hooks of the class, which are called without a run:

advise       train.py --advise and doctor.py look for options that suit a scene.
advise_trained  The same after a short training.
examine      doctor.py looks at a trained model.
backdrop     export.py separates the scene from what is behind it.

Hooks of a run (splatting/run.py), in the order of the calls. First the training is prepared:

make_schedule  The options and the checkpoint are read. Refuse here what can be refused.
dataset      The photos, cameras and points are found. Scenes made without a run call `dataset` and `cameras`, too.
cameras      The cameras of a list are made.
begin        The Gaussians exist. A new training has no optimiser yet, so the part may add rows.

Then, in each iteration:

terms        Return what the part adds to the loss.
due          Say whether the part will read the model or a loss, or write something.
measured     The losses are computed.
after_step   The optimiser has taken its step.
stepped      The iteration is done.

And at the end:

ended        The training is over, by its last iteration or by an error.

Observers are parts that only watch, by due, measured, stepped and ended. The core has some of its own, without a name
(splatting/loop.py). They are made when the log is open, and enter what must be closed into run.resources, an ExitStack.

Hooks of files:

records      A record of the log is written, or a point of the curve.
state        A checkpoint is written. It keeps the state under the part's name; a resumed run gives it to `begin`.
facts        model.json is written, when the training begins and with the last save.
save         A PLY or a checkpoint is written. Write the part's files beside it. Scenes without a run call `save`, too.
load         A saved model is loaded.
scored       The test views of a model are scored or rendered, in a training or after it.

A slot is an attribute of the run or of the model with a neutral default, which one part may replace in `begin`:

model.exposures corrections that turn renders into photos, trained with the Gaussians (scene/gaussians/exposure.py)
model.fixed  the Gaussians that density control leaves in their place and size
run.sizes    the size of a view in an iteration
run.pixel_filter  the pixels of a view that count in its loss. It may learn from renders, so no step is taken twice, and
             the host does not run ahead of a GPU.
run.camera_steps  the optimiser of cameras, by the gradients of their numbers, on the host: `place`, `step`,
             `count_independent`

Keep values per row in model.columns, which move with the rows.
"""

import argparse
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeAlias

from torch import Tensor

from gaussian_renderer.scored_views import ScoredViews
from groundwork.finding import Finding
from scene.cameras import Camera
from scene.gaussians.density_rules import Actions, Window
from scene.readers.info import CameraInfo, SceneInfo
from scene.readers.tracks import PhotoPoints
from scene.scene import Scene
from splatting.iteration import Iteration, Losses, Term
from splatting.schedule import Schedule
from utils.system_utils import UserError

if TYPE_CHECKING:
    from splatting.run import Run

Error: TypeAlias = BaseException | None
Scored: TypeAlias = tuple[ScoredViews | None, Sequence[Camera]]  # how, None: as all others; and which views


@dataclass(frozen=True)
class Needs:
    """Requirements of a part on the steps. They are data, because a captured step cannot ask a part while it replays.

    depth: steps that have terms of the part render depth, `package["depth"]`, which is None otherwise.
    captured: a captured step may record the part's terms. The terms then depend on the render and on the view's photo
        alone, not on the iteration: a recorded weight never changes. `terms` gets a placeholder that has a camera, and
        `measured` finds nothing in `losses.terms`.
    ranks: the part works with several processes.
    length: the part's steps depend on --iterations, so that a short training does not begin a longer one.
    files: the part reads files of the scene besides photos.
    resets: strategies may reset opacities by default, which turns renders dark for a while.
    """

    depth: bool = False
    captured: bool = False
    ranks: bool = True
    files: bool = False
    resets: bool = True
    length: bool = False


class Part:
    """Base class of all parts.

    name: name of the module, which is the key of the part's state and of its options in arguments/features.py, and the
        option that brings the part in.
    active: true if the part takes part. `begin` may clear this flag where a scene has no use for the part, and no
        further hooks are called.
    needs: requirements of the part on the steps.
    against: options that the part does not work with, as `option` or `option=value`; each with the rest of a sentence,
        which says why, and what to do.
    ends_by: options of the part that let a training end before or after --iterations, by name; true if the same option
        trains a finished training further.
    """

    name: ClassVar[str] = ""
    active = True
    needs: ClassVar[Needs] = Needs()
    against: ClassVar[dict[str, str]] = {}
    ends_by: ClassVar[dict[str, bool]] = {}

    @classmethod
    def asked_by(cls, given: argparse.Namespace) -> str:
        """Return the option that asks for the part, as a user types it; "" if none does."""
        return f"--{cls.name}" if getattr(given, cls.name, False) else ""

    @classmethod
    def joins_by_state(cls, given: argparse.Namespace, iteration: int) -> bool:
        """Tell whether a state in a checkpoint brings the part in where no option asks for it.

        Where it does not, a warning may say so, or a UserError refuse the checkpoint.

        given: options of all groups.
        iteration: iteration of the checkpoint.
        """
        return False

    @staticmethod
    def advise(scene: Scene, tracks: Sequence[PhotoPoints | None]) -> Iterable[Finding]:
        """Return findings on a scene, with the options of train.py that the findings speak for."""
        return ()

    @staticmethod
    def advise_trained(scene: Scene, views: ScoredViews) -> Iterable[Finding]:
        """Return findings as `advise` does, after a short training of small photos."""
        return ()

    @staticmethod
    def examine(scene: Scene, views: ScoredViews) -> Iterable[Finding]:
        """Return notes on a trained model."""
        return ()

    @staticmethod
    def backdrop(facts: dict[str, Any], means: Tensor) -> Tensor | None:
        """Return a mask of the Gaussians that are not of the scene itself, (N,) bool; None: this part has added none.

        facts: entries of model.json.
        means: (N, 3), in the model's frame.
        """
        return None

    def make_schedule(
        self, opt: argparse.Namespace, checkpoint: str | None, first_iteration: int, state: Any
    ) -> Schedule | None:
        """Return the schedule of the run; None: the part has none. Nothing is written yet.

        checkpoint: path of the checkpoint that is resumed, or None.
        first_iteration: iteration of the checkpoint, or 0.
        state: the part's entry in the checkpoint; None without one.
        """

    def dataset(self, info: SceneInfo, args: argparse.Namespace, fresh: bool) -> SceneInfo:
        """Return the dataset, with other views or points if need be.

        args: the model options.
        fresh: true if the dataset is read to train, also from a checkpoint; false if it is for a saved model.
        """
        return info

    def cameras(self, scene: Scene, cameras: Sequence[tuple[Camera, CameraInfo]], held_out: bool) -> None:
        """Adapt cameras of the scene. The list holds each camera with the record that it was made from.

        held_out: true for views that are held out; otherwise the cameras are those of training views.
        """

    def begin(self, run: "Run", state: Any) -> None:
        """Take part in a training.

        state: the part's entry in the checkpoint; None: the training is new, or the checkpoint has no entry.
        """

    def terms(self, at: Iteration) -> dict[str, Term]:
        """Return the terms that the part adds to the loss in this iteration, weights included, by their names in logs.

        A term is a function of the result of `render`, not clamped, and of the mask of the pixels that count. The
        columns that count are at.camera.columns. `photometric_loss` of utils/loss_utils.py takes all of these.
        """
        return {}

    def after_step(self, at: Iteration) -> None:
        """Act after the optimiser has taken the iteration's step; not called in the last iteration, which takes none.

        at.changes: true if rows, the SH degree or sizes of views have changed, or will be changed by later parts.
        """

    def records(self) -> dict[str, float]:
        """Return numbers for a record of the log. All parts have seen the iteration's losses by then."""
        return {}

    def save(self, scene: Scene) -> None:
        """Write the part's files into the model folder of a scene, beside a PLY or a checkpoint."""

    def load(self, scene: Scene, args: argparse.Namespace) -> None:
        """Read the part's files from the model folder, after the Gaussians were loaded.

        args: the model options.
        """

    def scored(self, scene: Scene, pipe: argparse.Namespace, background: Any) -> dict[str, Scored]:
        """Return further sets of test views, each by the suffix that its name gets."""
        return {}

    def state(self) -> Any:
        """Return the part's state for a checkpoint, as tensors and plain values; None: no state."""

    def facts(self) -> dict[str, Any]:
        """Return entries for model.json."""
        return {}

    def due(self, at: Iteration) -> bool:
        """Tell whether the part reads the model or a loss, or writes something, in this iteration, which now begins.

        If so, all earlier steps are done by the time of `measured`, and every loss so far is checked first. If no part
        says so, the GPU may be some steps behind in `measured` and `stepped`: tensors that these hooks get may be kept,
        but not read. A part that reads losses alone sets at.due and returns false: blocks of rows then sleep on.
        """
        raise NotImplementedError

    def measured(self, at: Iteration, losses: Losses) -> None:
        """Take note of the losses. In an iteration that is due, the model is still the one that was rendered."""

    def stepped(self, at: Iteration) -> None:
        """Act at the end of an iteration: density control and optimiser are done, the model is that of the next one."""

    def ended(self, error: Error) -> None:
        """Act at the end of the training.

        error: None after the last iteration; otherwise the error that ended the training, which the hook may replace by
            raising another one.
        """


class Rates(NamedTuple):
    """Factors of learning rates, and a constant of Adam, that a strategy chooses for an iteration."""

    factor: float | None = None  # of rates that have no schedule; None: 1. The factor of a schedule goes first
    bands: float = 1.0  # further factor for SH bands above degree 0
    beta2: float | None = None  # decay of Adam's averages of squared gradients; None: that of the optimiser


class Strategy(Part):
    """A part that decides the number and places of Gaussians (--strategy NAME): one in each training, `run.strategy`.

    A strategy joins a run once it is chosen, which may be late: `begin` is called when the model has its optimiser, and
    all later hooks after that.

    until: option of the step at which the strategy ends, and the part of the schedule that is its default.
    clamps: true if the loss takes renders clamped to [0, 1], as the reference's does. Gaussians brighter than white
        then cost nothing before a white background.
    fusable: true if the strategy needs no gradient besides the statistics. Steps are then fused
        (splatting/faster/fused.py). A fused step never calls `after_backward`. It asks `skips_step` and then calls
        `change_rows` where the iteration changes something. A subclass does not inherit this flag, as it may need more.
    queues: true if `after_step` queues operators that change the model. It queues nothing else, except in iterations
        whose `at.density.changes` is true.

    Attributes of a run, set in `begin`:

    schedule: schedule of the run (splatting/schedule.py). Rules that are windows of the schedule ask it for the present
        step; rules that count steps take the iteration.
    window: start, end and stride of densifications, in steps of the schedule.
    max_gaussians: largest number of Gaussians, 0: any number.
    penalty: part of the loss besides the objective, whose gradients the steps add (scene/gaussians/penalty.py). No
        reported loss includes it.
    """

    until: ClassVar[tuple[str, float]] = "densify_until_iter", 1 / 2
    clamps: ClassVar[bool] = True
    fusable: ClassVar[bool] = False
    queues: ClassVar[bool] = False
    schedule: Schedule
    window: Window
    max_gaussians = 0
    penalty: Any = ()

    @classmethod
    def asked_by(cls, given: argparse.Namespace) -> str:
        return f"--strategy {cls.name}" if getattr(given, "strategy", "") == cls.name else ""

    @classmethod
    def best_in(cls, seconds: float, run: "Run") -> bool:
        """Tell whether the strategy is the best one for a run of so many seconds. The first one to say so is taken."""
        return False

    @classmethod
    def takes_absolute(cls, opt: argparse.Namespace) -> bool:
        """Tell whether the statistics take the lengths of absolute gradients (Ye et al. 2024), which need memory."""
        return False

    def begin(self, run: "Run", state: Any) -> None:
        self._gaussians, self._opt, self.schedule = run.gaussians, run.opt, run.schedule
        self.window = Window(run.opt.densify_from_iter, getattr(run.opt, self.until[0]), run.opt.densification_interval)

    def actions(self, iteration: int) -> Actions:
        """Return what density control does in an iteration. The run asks once, and keeps the answer in `at.density`."""
        schedule = self.schedule
        step, stride = schedule.schedule_step(iteration), schedule.stride(iteration)
        due = step > self.window.start and self.window.is_due(iteration, step, stride)
        return Actions(changes=due, densify=due)

    def skips_step(self, at: Iteration) -> Collection[str]:
        """Return the attributes that `change_rows` will give new values or rows, and which therefore take no step now.

        A fused step asks before anything of the iteration changes the model. Every rank must call it.
        """
        return ()

    def rates(self, iteration: int) -> Rates:
        """Return the strategy's choice of learning rates in an iteration."""
        return Rates()

    def after_backward(self, at: Iteration, package: dict[str, Any]) -> None:
        """Act when all gradients are computed, before Adam steps: add the view to the statistics, and change rows.

        Only plain steps call this hook.

        package: the result of `render`.
        """
        if at.density.observe:
            absolute, gaussians = self.takes_absolute(self._opt), self._gaussians
            observe = gaussians.observe_absolute if absolute else gaussians.observe
            observe(package["viewspace_points"], package["radii"])
        self.change_rows(at)

    def change_rows(self, at: Iteration) -> None:
        """Change the attributes that `skips_step` names, once the view has been added to the statistics."""


class Appearance(Part):
    """A part that trains how photos differ from renders (--appearance KIND). A training has at most one.

    kind: value of the option.
    flag: a further option that asks for the part. arguments/features.py has both as well.
    """

    kind: ClassVar[str] = ""
    flag: ClassVar[str] = ""

    @classmethod
    def asked_by(cls, given: argparse.Namespace) -> str:
        if getattr(given, "appearance", "none") == cls.kind:
            return f"--appearance {cls.kind}"
        return f"--{cls.flag}" if cls.flag and getattr(given, cls.flag, False) else ""

    @classmethod
    def joins_by_state(cls, given: argparse.Namespace, iteration: int) -> bool:
        option = f"--{cls.flag}" if cls.flag else f"--appearance {cls.kind}"
        raise UserError(f"{given.start_checkpoint} was trained with {option}; give that option")
