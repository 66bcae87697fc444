"""The manual of parts: what a feature adds to a training, in one class, which lies in one file.

A part is a subclass of `Part` in splatting/features/NAME.py, called by NAME in capital words (depth_tv: DepthTv), and
stands in the list of splatting/registry.py. Its place there is that in the one order of all hooks. Its options, if it
has any, are an entry of arguments/features.py. No other file names it. Hooks are optional; those that a class does not
override cost nothing. A long method lies in a second file beside it, NAME_*.py.

Other people's programs may have a package `arguments` of their own, and make scenes, which load parts. So these import
`arguments`, and what imports it, only where a training calls them.

Classes are asked outside of a run, so these hooks are of the class:

prepare      train.py has read its options. It may change them, or say that nothing is left to train.
advise       train.py --advise and doctor.py look for options that a scene asks for.
advise_trained  The same by a short training.
examine      doctor.py looks at a trained model.
backdrop     export.py separates the scene from what is behind it.

A run (splatting/run.py), in the order in which it calls the hooks:

check        The options and the checkpoint are read, and the model is empty. Refuse here what can be refused.
dataset      The photos, cameras and points are found. Scenes that are made without a run call it, too, and the next.
cameras      The cameras of a list are made.
begin        The Gaussians exist. In a new training they have no optimiser yet, so rows may be added.
ready        Model and optimiser exist.
opened       The log is open, and files may be written. What must be closed goes into run.resources, an ExitStack.
terms        In each iteration, before its step: what it adds to the loss.
begins, due, measured, stepped, ended
             What observers see. The core's own (splatting/loop.py) are parts without a name.
changes      Asked in each iteration: whether rows or sizes will change in it.
after_step   The optimiser has taken its step.
records      A record of the log is written, or a point of the curve.
state        A checkpoint is written. It keeps the state by the part's name, and gives it back to `begin`.
facts        model.json is written, when the training begins and with the last save.
save         A PLY or a checkpoint is written: own files beside it. Scenes that are made without a run call it, too.
load, scored A saved model is loaded, and its test views are to be scored or rendered, in a training or without one.

What only one part can give is a slot of the run or of the model, with a neutral default that the part replaces in
`begin`, or earlier; a second one that does so is refused by `fill`:

model.exposures what photos make of renders, trained with the Gaussians (scene/gaussians/exposure.py)
model.fixed  which Gaussians density control leaves where they are, and as large as they are
model.storage where rows lie: on the device, or a part of them on the host (scene/gaussians/spilled.py)
run.schedule which steps of the schedule an iteration stands for
run.views    the view of an iteration
run.sizes    the size of a view in an iteration
run.sleeping which blocks of rows take a step (scene/sleeping.py)
run.pixel_filter  which pixels of a view count in its loss. It may learn by renders, so no step is taken twice, and
             the host does not run ahead of a GPU.
run.has_new_photos  whether the scene has more photos than the checkpoint was trained on
run.camera_steps  takes the steps of cameras, by the gradients of their numbers, on the host: `place`, `step`,
             `independent`

Values per row, which move with the rows, lie in model.columns.
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
    """What a part asks of the steps. It is data, because a captured step cannot ask anybody while it replays.

    depth: steps that have terms of the part render depth, `package["depth"]`, which is None otherwise.
    captured: a captured step may record its terms, which depend on the render and on the view's photo alone, so not on
        the iteration: a recorded weight never changes. `terms` is then asked with a placeholder that has a camera, and
        `measured` finds nothing in `losses.terms`.
    ranks: it works with several processes.
    files: it reads files of the scene besides photos.
    resets: strategies may reset opacities, so that renders turn dark, though nobody has told them how often.
    """

    depth: bool = False
    captured: bool = False
    ranks: bool = True
    files: bool = False
    resets: bool = True


class Part:
    """Base of all parts.

    name: of its module, the key of its state and of its options in arguments/features.py, and the option that brings it
    in.
    active: whether it takes part; `begin` may clear it where a scene has no use for the part, which then has no hooks.
    by_state: whether its state in a checkpoint brings the part in where no option asks for it.
    needs: what it asks of the steps.
    against: what it does not work with, `option` or `option=value`, and the rest of a sentence: why, and what to do.
    reads_model: whether it reads the model in iterations that are due for it; sleeping blocks then catch up first.
    told_last: as it may let the training wait: when all else of an iteration is done and written.
    ends_by: its options that let a training end before or after --iterations, and whether the same ones train a
    finished training further.
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
        """Whether the options ask for the part."""
        return bool(getattr(given, cls.name, False))

    @classmethod
    def asked_by(cls, given: argparse.Namespace) -> str:
        """The option that asks for the part, as it is typed."""
        return f"--{cls.name}"

    @classmethod
    def dropped(cls, given: argparse.Namespace, iteration: int) -> str | None:
        """What to warn of where a checkpoint has a state of the part, and no option asks for it. UserError refuses it.

        given: options of all groups. iteration: of the checkpoint.
        """
        return None

    @classmethod
    def follows_length(cls, given: argparse.Namespace) -> bool:
        """Whether, by these options, steps depend on --iterations: a shorter training does not begin a longer one."""
        return False

    @classmethod
    def prepare(
        cls, dataset: argparse.Namespace, opt: argparse.Namespace, launch: argparse.Namespace, stops: Mapping[str, bool]
    ) -> bool:
        """Change options before a training. Returns whether anything is left to train. stops: all parts' `ends_by`."""
        return True

    @staticmethod
    def advise(scene: Scene, tracks: Sequence[Track | None]) -> Iterable[Finding]:
        """Return findings on a scene, and options of train.py that they speak for."""
        return ()

    @staticmethod
    def advise_trained(scene: Scene, views: ScoredViews) -> Iterable[Finding]:
        """Do as `advise`, by a short training of small photos."""
        return ()

    @staticmethod
    def examine(scene: Scene, views: ScoredViews) -> Iterable[Finding]:
        """Return notes on a trained model."""
        return ()

    @staticmethod
    def backdrop(facts: dict[str, Any], means: Tensor) -> Tensor | None:
        """Return which Gaussians of a model are not of the scene itself, (N,) bool; None: it has none of this part's.

        facts: of model.json. means: (N, 3) in the model's frame.
        """
        return None

    def check(self, run: "Run", state: Any) -> None:
        """Refuse what cannot be trained (UserError). Nothing is written yet. state: as for `begin`."""

    def dataset(self, info: SceneInfo, args: argparse.Namespace, fresh: bool) -> SceneInfo:
        """The dataset with other views or points. args: the model options. fresh: it is read for a new training."""
        return info

    def cameras(self, scene: Scene, cameras: Sequence[tuple[Camera, CameraInfo]], held_out: bool) -> None:
        """Cameras of the scene's training views, or of those that are held out, with the records they are made of."""

    def begin(self, run: "Run", state: Any) -> None:
        """Take part in a training. state: its entry of the checkpoint; None: a new training, or one that had none."""

    def ready(self, run: "Run") -> None:
        """The model has its rows and its optimiser."""

    def opened(self, run: "Run") -> None:
        """The log is open, and files may be written."""

    def terms(self, at: Iteration) -> dict[str, Term]:
        """What the iteration adds to the loss, weights included, by names for logs.

        A term gets the result of `render`, not clamped, and the mask of the pixels that count; at.camera.columns are
        the columns that count. `photometric_loss` of utils/loss_utils.py takes all of these.
        """
        return {}

    def changes(self, iteration: int) -> bool:
        """Whether something changes in an iteration besides its step, such as the Gaussians' rows.

        If so, every loss so far is checked first, because a change cannot be undone.
        """
        return False

    def after_step(self, at: Iteration) -> None:
        """The optimiser has taken the iteration's step, so not in the last iteration, which takes none.

        at.changes: rows, the SH degree or sizes of views have changed, or will by parts that follow.
        """

    def records(self) -> dict[str, float]:
        """Numbers for a record of the log, asked once all parts are told of the iteration's losses."""
        return {}

    def save(self, scene: Scene) -> None:
        """Write own files into the model folder of a scene, beside a PLY or a checkpoint."""

    def load(self, scene: Scene, args: argparse.Namespace) -> None:
        """Read own files of the model folder, once its Gaussians are loaded. args: the model options."""

    def scored(self, scene: Scene, pipe: argparse.Namespace, background: Any) -> dict[str, Scored]:
        """Further sets of test views, by what is put behind the name of the set."""
        return {}

    def state(self) -> Any:
        """What a checkpoint keeps, as tensors and plain values; None: nothing."""

    def facts(self) -> dict[str, Any]:
        """Entries of model.json."""
        return {}

    def due(self, at: Iteration) -> bool:
        """Whether this iteration reads the model or a loss, or writes something. Asked once, when it begins.

        If so, all steps before it are done by then, and every loss so far is checked first in `measured`. Otherwise the
        GPU may be some steps behind in `measured` and `stepped`, so what these get must not be read, only noted.
        """
        raise NotImplementedError

    def begins(self, at: Iteration) -> None:
        """The iteration begins, with its view."""

    def measured(self, at: Iteration, losses: Losses) -> None:
        """The losses are computed. If the iteration is due, the model is still the one that was rendered."""

    def stepped(self, at: Iteration) -> None:
        """Density control and optimiser are done; the model is that of the next iteration."""

    def ended(self, error: Error) -> None:
        """Training is over: after its last iteration (None), or by an error, which may be replaced by raising."""


class Strategy(Part):
    """A part of which each training has one, `run.strategy`: how many Gaussians there are, and where (--strategy NAME).

    It joins a run once it is chosen, which may be late: `check` and `begin` are called then, when the model has its
    optimiser, and all hooks after them.
    until: the option of the step at which it ends, and the part of the schedule that this is by default.
    removes: whether it removes Gaussians down to a given number.
    grows_to: whether it is meant to reach max_gaussians; not where nobody gives a number, with default_is_limit.
    clamps: whether the loss takes renders clamped to [0, 1], as the reference's does; then Gaussians brighter than
        white cost nothing before a white background.
    fusable: whether it needs no gradient besides the statistics. Steps are then fused (training/steps/fused.py). These
        never call `after_backward`; they ask `observes`, and where `changes` says so `skips_step`, and then call
        `change_rows`. It counts only where the class itself says so: a subclass may want more.
    queues: whether `after_step` queues operators that change the model; it queues nothing else, unless the iteration is
        one that `changes` names.
    seen_only: whether a step concerns only what the view sees, as with --optimizer_type sparse_adam.

    Of a run, set in `begin`:
    max_gaussians: how many it lets there be, 0: any number.
    band_rate: factor of the learning rate of SH bands above degree 0.
    ends: the iteration of the schedule from which it changes no rows.
    penalty: a part of the loss besides the objective, of which steps add the gradients (scene/gaussians/penalty.py). No
        loss that is told has it.
    absolute_gradients: whether the statistics take the lengths of absolute gradients (Ye et al. 2024).
    schedule: tells how far it is in an iteration (training/schedule.py). Rules that are windows of the schedule ask it;
        rules that count steps take the iteration.
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
        """Whether it is the best one for a run that takes so many seconds. The first that says so is taken."""
        return False

    @classmethod
    def takes_absolute(cls, opt: argparse.Namespace) -> bool:
        """Whether, by these options, its statistics take absolute gradients, which need memory."""
        return False

    def begin(self, run: "Run", state: Any) -> None:
        self.schedule = run.schedule

    def started(self) -> None:
        """Called before the first iteration of a model that was made from points, not read from a file."""

    def observes(self, iteration: int) -> bool:
        """Whether the view of this iteration counts in the Gaussians' statistics, where the step is fused."""
        return False

    def recovers(self, iteration: int) -> bool:
        """Whether opacities were reset so recently that renders are not like photos."""
        return False

    def resets(self, iteration: int) -> bool:
        """Whether all opacities are reset in this iteration."""
        return False

    def skips_step(self, iteration: int) -> Collection[str]:
        """Attributes that `change_rows` will give other values or rows, so that they take no step in this iteration.

        Asked, where the step is fused, before anything of the iteration changes the model. Every rank must call it.
        """
        return ()

    def projected_count(self, count: int, first: int, last: int) -> int:
        """The most that `count` Gaussians can become from iteration `first` to `last`, both known to the schedule.

        `max_gaussians` where the strategy has no number to reach.
        """
        return self.max_gaussians

    def too_slow(self) -> str:
        """Why it may not reach its number of Gaussians in time, and what to do."""
        return "they at most double each time; lower --densification_interval"

    def rate_factor(self, iteration: int) -> float | None:
        """Factor of the learning rates that have no schedule, where the run's schedule has none. None: 1."""
        return None

    def beta2(self, iteration: int) -> float | None:
        """Decay of Adam's averages of squared gradients. None: the optimiser's."""
        return None

    def after_backward(self, at: Iteration, package: dict[str, Any]) -> None:
        """Called with all gradients computed, before Adam. Plain steps only. package: the result of `render`."""
        self.change_rows(at)

    def change_rows(self, at: Iteration) -> None:
        """Change what `skips_step` tells of, once the view counts in the statistics."""


class Appearance(Part):
    """A part that trains how photos show renders (--appearance KIND), of which a training has one at most.

    kind: the value of the option. flag: a further option that asks for it. arguments/features.py has both, too.
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
    """The bound hooks of the parts whose class overrides it."""
    plain = getattr(Part, hook)
    return [getattr(part, hook) for part in parts if getattr(type(part), hook) is not plain]


def fill(owner: Any, slot: str, value: Any, part: Part) -> None:
    """Let a part provide a slot. UserError if another part does already."""
    providers = owner.__dict__.setdefault("_providers", {})
    if (other := providers.setdefault(slot, part.name)) != part.name:
        raise UserError(f"--{part.name} does not work with --{other}: both set {slot}; leave one of them out")
    setattr(owner, slot, value)
