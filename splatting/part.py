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

prepare      train.py has read its options. The hook may change the options, or say that nothing is left to train.
advise       train.py --advise and doctor.py look for options that suit a scene.
advise_trained  The same after a short training.
examine      doctor.py looks at a trained model.
backdrop     export.py separates the scene from what is behind it.

Hooks of a run (splatting/run.py), in the order of the calls. First the training is prepared:

check        The options and the checkpoint are read, and the model is empty. Refuse here what can be refused.
dataset      The photos, cameras and points are found. Scenes made without a run call `dataset` and `cameras`, too.
cameras      The cameras of a list are made.
begin        The Gaussians exist. A new training has no optimiser yet, so the part may add rows.
ready        The model and the optimiser exist.
opened       The log is open, and files may be written. Enter what must be closed into run.resources, an ExitStack.

Then, in each iteration:

changes      Say whether rows or sizes will change in the iteration.
terms        Return what the part adds to the loss.
due          Say whether the part will read the model or a loss, or write something.
begins       The iteration begins.
measured     The losses are computed.
after_step   The optimiser has taken its step.
stepped      The iteration is done.

And at the end:

ended        The training is over, by its last iteration or by an error.

Observers are parts that only watch, by due, begins, measured, stepped and ended. The core has some of its own, without
a name (splatting/loop.py).

Hooks of files:

records      A record of the log is written, or a point of the curve.
state        A checkpoint is written. It keeps the state under the part's name; a resumed run gives it to `begin`.
facts        model.json is written, when the training begins and with the last save.
save         A PLY or a checkpoint is written. Write the part's files beside it. Scenes without a run call `save`, too.
load         A saved model is loaded.
scored       The test views of a model are scored or rendered, in a training or after it.

A slot is an attribute of the run or of the model that one part may provide. It has a neutral default, which the part
replaces by `fill`, in `begin` or earlier. `fill` refuses a second part for the same slot:

model.exposures corrections that turn renders into photos, trained with the Gaussians (scene/gaussians/exposure.py)
model.fixed  the Gaussians that density control leaves in their place and size
model.storage the memory of the rows: the device, or for a part of them the host (scene/gaussians/spilled.py)
run.schedule the steps of the schedule that an iteration stands for
run.views    the view of an iteration
run.sizes    the size of a view in an iteration
run.sleeping the blocks of rows that take a step (scene/sleeping.py)
run.pixel_filter  the pixels of a view that count in its loss. It may learn from renders, so no step is taken twice, and
             the host does not run ahead of a GPU.
run.has_new_photos  true if the scene has more photos than the checkpoint was trained on
run.camera_steps  the optimiser of cameras, by the gradients of their numbers, on the host: `place`, `step`,
             `independent`

Keep values per row in model.columns, which move with the rows.
"""

import argparse
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

from torch import Tensor

from gaussian_renderer.scored_views import ScoredViews
from groundwork.finding import Finding
from scene.cameras import Camera
from scene.readers.info import CameraInfo, SceneInfo
from scene.readers.tracks import Track
from scene.scene import Scene
from splatting.iteration import Iteration, Losses, Term
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
    files: the part reads files of the scene besides photos.
    resets: strategies may reset opacities by default, which turns renders dark for a while.
    """

    depth: bool = False
    captured: bool = False
    ranks: bool = True
    files: bool = False
    resets: bool = True


class Part:
    """Base class of all parts.

    name: name of the module, which is the key of the part's state and of its options in arguments/features.py, and the
        option that brings the part in.
    active: true if the part takes part. `begin` may clear this flag where a scene has no use for the part, and no
        further hooks are called.
    by_state: true if a state in a checkpoint brings the part in where no option asks for it.
    needs: requirements of the part on the steps.
    against: options that the part does not work with, as `option` or `option=value`; each with the rest of a sentence,
        which says why, and what to do.
    reads_model: true if the part reads the model in iterations that are due for it. Sleeping blocks then catch up
        first.
    told_last: true if the part may make the training wait. It is then called when all else of an iteration is done and
        written.
    ends_by: options of the part that let a training end before or after --iterations, by name; true if the same option
        trains a finished training further.
    """

    name: ClassVar[str] = ""
    active = True
    by_state: ClassVar[bool] = False
    needs: ClassVar[Needs] = Needs()
    against: ClassVar[dict[str, str]] = {}
    reads_model: ClassVar[bool] = True
    told_last: ClassVar[bool] = False
    ends_by: ClassVar[dict[str, bool]] = {}

    @classmethod
    def wanted(cls, given: argparse.Namespace) -> bool:
        """Tell whether the options ask for the part."""
        return bool(getattr(given, cls.name, False))

    @classmethod
    def asked_by(cls, given: argparse.Namespace) -> str:
        """Return the option that asks for the part, as a user types it."""
        return f"--{cls.name}"

    @classmethod
    def dropped(cls, given: argparse.Namespace, iteration: int) -> str | None:
        """Return a warning where a checkpoint has a state of the part and no option asks for the part, or None.

        Raise UserError to refuse such a checkpoint.

        given: options of all groups.
        iteration: iteration of the checkpoint.
        """
        return None

    @classmethod
    def follows_length(cls, given: argparse.Namespace) -> bool:
        """Tell whether steps depend on --iterations, by these options: a short training does not begin a longer one."""
        return False

    @classmethod
    def prepare(
        cls, dataset: argparse.Namespace, opt: argparse.Namespace, launch: argparse.Namespace, stops: Mapping[str, bool]
    ) -> bool:
        """Change options before a training. Return whether anything is left to train.

        stops: `ends_by` of all parts.
        """
        return True

    @staticmethod
    def advise(scene: Scene, tracks: Sequence[Track | None]) -> Iterable[Finding]:
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

    def check(self, run: "Run", state: Any) -> None:
        """Refuse what cannot be trained (UserError). Nothing is written yet.

        state: as for `begin`.
        """

    def dataset(self, info: SceneInfo, args: argparse.Namespace, fresh: bool) -> SceneInfo:
        """Return the dataset, with other views or points if need be.

        args: the model options.
        fresh: true if the dataset is read for a new training.
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

    def ready(self, run: "Run") -> None:
        """Act on the model, which now has its rows and its optimiser."""

    def opened(self, run: "Run") -> None:
        """Prepare the part's output: the log is open, and files may be written."""

    def terms(self, at: Iteration) -> dict[str, Term]:
        """Return the terms that the part adds to the loss in this iteration, weights included, by their names in logs.

        A term is a function of the result of `render`, not clamped, and of the mask of the pixels that count. The
        columns that count are at.camera.columns. `photometric_loss` of utils/loss_utils.py takes all of these.
        """
        return {}

    def changes(self, iteration: int) -> bool:
        """Tell whether an iteration changes something besides taking its step, such as the rows of the Gaussians.

        Every loss so far is then checked first, because such a change cannot be undone.
        """
        return False

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
        but not read.
        """
        raise NotImplementedError

    def begins(self, at: Iteration) -> None:
        """Prepare for an iteration, whose view is known."""

    def measured(self, at: Iteration, losses: Losses) -> None:
        """Take note of the losses. In an iteration that is due, the model is still the one that was rendered."""

    def stepped(self, at: Iteration) -> None:
        """Act at the end of an iteration: density control and optimiser are done, the model is that of the next one."""

    def ended(self, error: Error) -> None:
        """Act at the end of the training.

        error: None after the last iteration; otherwise the error that ended the training, which the hook may replace by
            raising another one.
        """


class Strategy(Part):
    """A part that decides the number and places of Gaussians (--strategy NAME): one in each training, `run.strategy`.

    A strategy joins a run once it is chosen, which may be late: when the model has its optimiser, the run calls `check`
    and `begin`, and then all later hooks.

    until: option of the step at which the strategy ends, and the part of the schedule that is its default.
    removes: true if the strategy removes Gaussians down to a given number.
    grows_to: true if the strategy is meant to reach max_gaussians.
    default_is_limit: true if max_gaussians is only a limit, not an aim, where nobody gives a number.
    clamps: true if the loss takes renders clamped to [0, 1], as the reference's does. Gaussians brighter than white
        then cost nothing before a white background.
    fusable: true if the strategy needs no gradient besides the statistics. Steps are then fused
        (splatting/faster/fused.py). A fused step never calls `after_backward`. It asks `observes`, and, where `changes`
        is true, asks `skips_step` and then calls `change_rows`. A subclass does not inherit this flag, as it may need
        more.
    queues: true if `after_step` queues operators that change the model. It queues nothing else, except in iterations
        for which `changes` is true.
    seen_only: true if a step concerns only what the view sees, as with --optimizer_type sparse_adam.

    Attributes of a run, set in `begin`:

    max_gaussians: largest number of Gaussians, 0: any number.
    band_rate: factor of the learning rate of SH bands above degree 0.
    ends: iteration of the schedule from which on the strategy changes no rows.
    penalty: part of the loss besides the objective, whose gradients the steps add (scene/gaussians/penalty.py). No
        reported loss includes it.
    absolute_gradients: true if the statistics take the lengths of absolute gradients (Ye et al. 2024).
    schedule: schedule of the run (splatting/schedule.py). Rules that are windows of the schedule ask it for the present
        step; rules that count steps take the iteration.
    """

    until: ClassVar[tuple[str, float]] = "densify_until_iter", 1 / 2
    removes: ClassVar[bool] = False
    grows_to: ClassVar[bool] = True
    default_is_limit: ClassVar[bool] = False
    clamps: ClassVar[bool] = True
    fusable: ClassVar[bool] = False
    queues: ClassVar[bool] = False
    seen_only: ClassVar[bool] = False
    max_gaussians = 0
    band_rate = 1.0
    ends = math.inf
    penalty: Any = ()
    absolute_gradients = False
    schedule: Any = None

    @classmethod
    def wanted(cls, given: argparse.Namespace) -> bool:
        return False  # the run lets it join

    @classmethod
    def asked_by(cls, given: argparse.Namespace) -> str:
        return f"--strategy {cls.name}"

    @classmethod
    def best_in(cls, seconds: float, run: "Run") -> bool:
        """Tell whether the strategy is the best one for a run of so many seconds. The first one to say so is taken."""
        return False

    @classmethod
    def takes_absolute(cls, opt: argparse.Namespace) -> bool:
        """Tell whether the statistics take absolute gradients, which need memory, by these options."""
        return False

    def begin(self, run: "Run", state: Any) -> None:
        self.schedule = run.schedule

    def started(self) -> None:
        """Prepare the Gaussians for the first iteration of a model that was made from points, not read from a file."""

    def observes(self, iteration: int) -> bool:
        """Tell whether the view of this iteration counts in the Gaussians' statistics, where the step is fused."""
        return False

    def recovers(self, iteration: int) -> bool:
        """Tell whether opacities were reset so recently that renders do not resemble photos yet."""
        return False

    def resets(self, iteration: int) -> bool:
        """Tell whether all opacities are reset in this iteration."""
        return False

    def skips_step(self, iteration: int) -> Collection[str]:
        """Return the attributes that `change_rows` will give new values or rows, and which therefore take no step now.

        A fused step asks before anything of the iteration changes the model. Every rank must call it.
        """
        return ()

    def projected_count(self, count: int, first: int, last: int) -> int:
        """Return the most that `count` Gaussians can become in iterations `first` to `last`, which the schedule knows.

        That is `max_gaussians` where the strategy has no number to reach.
        """
        return self.max_gaussians

    def too_slow(self) -> str:
        """Say why the strategy may not reach its number of Gaussians in time, and what to do."""
        return "they at most double each time; lower --densification_interval"

    def rate_factor(self, iteration: int) -> float | None:
        """Return the factor of learning rates that have no schedule; None: 1.

        The run's schedule goes first: the strategy is asked only where the schedule has no factor.
        """
        return None

    def beta2(self, iteration: int) -> float | None:
        """Return the decay of Adam's averages of squared gradients; None: that of the optimiser."""
        return None

    def after_backward(self, at: Iteration, package: dict[str, Any]) -> None:
        """Act when all gradients are computed, before Adam steps. Only plain steps call this hook.

        package: the result of `render`.
        """
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
    def wanted(cls, given: argparse.Namespace) -> bool:
        return getattr(given, "appearance", "none") == cls.kind or bool(cls.flag and getattr(given, cls.flag, False))

    @classmethod
    def asked_by(cls, given: argparse.Namespace) -> str:
        named = getattr(given, "appearance", "none") == cls.kind or not cls.flag
        return f"--appearance {cls.kind}" if named else f"--{cls.flag}"

    @classmethod
    def dropped(cls, given: argparse.Namespace, iteration: int) -> str | None:
        option = f"--{cls.flag}" if cls.flag else f"--appearance {cls.kind}"
        raise UserError(f"{given.start_checkpoint} was trained with {option}; give that option")

    @classmethod
    def follows_length(cls, given: argparse.Namespace) -> bool:
        return cls.wanted(given)  # by its learning rate


def overrides(parts: Sequence[Part], hook: str) -> list[Callable]:
    """Return the bound hooks of the parts whose class overrides a hook."""
    plain = getattr(Part, hook)
    return [getattr(part, hook) for part in parts if getattr(type(part), hook) is not plain]


def fill(owner: Any, slot: str, value: Any, part: Part) -> None:
    """Let a part provide a slot. UserError if another part already does."""
    providers = owner.__dict__.setdefault("_providers", {})
    if (other := providers.setdefault(slot, part.name)) != part.name:
        raise UserError(f"--{part.name} does not work with --{other}: both set {slot}; leave one of them out")
    setattr(owner, slot, value)
