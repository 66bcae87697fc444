"""Agreement of the processes that train together: on options and data at the start, on signals in each iteration."""

import argparse
import hashlib
import importlib.util
from collections.abc import Sequence
from pathlib import Path

from groundwork.host.interrupt import DeferredInterrupt, Terminated
from groundwork.ranks.ranks import Ranks, ranks, refuse_differences
from scene.cameras import Camera
from scene.gaussians.adam import StepGuard
from scene.scene import Scene
from splatting.iteration import Iteration, Losses
from splatting.part import Part

_ROOT = Path(__file__).resolve().parents[1]
_ROOMS = ("arguments", "gaussian_renderer", "splatting", "scene", "utils")
_EXTENSIONS = ("diff_gaussian_rasterization", "simple_knn", "fused_ssim")


def agree_on_options(args: argparse.Namespace) -> None:
    """Raise UserError if a rank has other code or options than rank 0."""
    if not ranks().several:
        return
    refuse_differences(ranks().all_gather_objects(_digest_code()), "give all ranks the same files", shown=False)
    options = {f"--{name}": str(value) for name, value in vars(args).items()}
    refuse_differences(ranks().all_gather_objects(options), "start all ranks with the same command")


def agree_on_scene(scene: Scene, start: str | None) -> None:
    """Raise UserError if a rank has read another scene or checkpoint than rank 0.

    start: path of the checkpoint that is resumed, or None.
    """
    if not ranks().several:
        return
    facts = {
        "the training views": _digest_cameras(scene.getTrainCameras()),
        "the test views": _digest_cameras(scene.getTestCameras()),
    }
    if start:
        facts[start] = hashlib.sha256(Path(start).read_bytes()).hexdigest()
    refuse_differences(ranks().all_gather_objects(facts), "give all ranks the same dataset", shown=False)


def _digest_code() -> dict[str, str]:
    """Return digests of the Python files that take part, by path, and of the extensions' binaries, by name."""
    paths = [_ROOT / "train.py", *(path for room in _ROOMS for path in (_ROOT / room).rglob("*.py"))]
    found = {str(path.relative_to(_ROOT)): path for path in sorted(paths)}
    for name in _EXTENSIONS:
        module = importlib.util.find_spec(name)
        if module is not None and module.origin is not None:
            found |= {f"{name}/{path.name}": path for path in sorted(Path(module.origin).parent.glob("*.so"))}
    return {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in found.items()}


def _digest_cameras(cameras: Sequence[Camera]) -> str:
    """Return a digest of cameras: names, sizes, lenses, matrices, and kinds of image files (photo, mask, depth map)."""
    digest = hashlib.sha256()
    for camera in cameras:
        kinds = [getattr(source, "suffix", type(source).__name__) for source, _ in getattr(camera, "undecoded", ())]
        size = camera.image_width, camera.image_height
        digest.update(f"{camera.image_name} {size} {kinds} {getattr(camera, 'lens', None)}\n".encode())
        digest.update(camera.full_proj_transform.cpu().numpy().tobytes())
    return digest.hexdigest()


_SIGNALS = (None, KeyboardInterrupt, Terminated)


class StepAgreement(Part):
    """Shares three facts of an iteration among ranks, so that all ranks act alike.

    - The iteration is due on a rank: somebody there reads or writes the model in it (`Iteration.due`).
    - A signal, as of Ctrl-C, asks a rank to stop.
    - The guard of a rank's optimisers (`StepGuard`) has found a loss or step that is not finite, and lets them take no
      further step.

    These facts travel with the numbers that ranks exchange to render the iteration's view (`all_gather_ints`), and are
    known when the losses are. A signal counts on all ranks for the iteration that begins after it, whichever rank has
    received it.
    """

    def __init__(self, group: Ranks, interrupt: DeferredInterrupt, guard: StepGuard | None) -> None:
        """Prepare the exchange.

        With several ranks, this makes the guard's `stopped` the `flag` of the group. Each exchange then raises it to
        the largest of all ranks: once the guard of one rank has stopped its optimisers, those of all ranks stop.

        group: the ranks that train together, or one process by itself.
        interrupt: signals that this process receives.
        guard: guard of this process's optimisers; None if they have none, as those of other programs. Then nothing
            about it is shared.
        """
        self._group, self._interrupt = group, interrupt
        if group.several:
            group.flag = None if guard is None else guard.stopped
        self._asked: type[KeyboardInterrupt] | None = None

    def begins(self, at: Iteration) -> None:
        self._group.piggyback(int(at.due), _SIGNALS.index(self._interrupt.requested))

    def measured(self, at: Iteration, losses: Losses) -> None:
        due, signal = self._group.latest()
        at.due = bool(due)
        self._asked = _SIGNALS[signal]

    @property
    def stopping(self) -> type[KeyboardInterrupt] | None:
        """The signal that asks to stop after this iteration, or None."""
        return self._asked if self._group.several else self._interrupt.requested

    def wait(self) -> None:
        """Wait until the first rank has written its files: torchrun ends all processes once one of them has ended."""
        self._group.any_rank(False)
