"""A checkpoint that is resumed with more photos than it was trained on: these train more often at first."""

from typing import TYPE_CHECKING, Any

from splatting.part import Part, fill
from utils.system_utils import UserError

if TYPE_CHECKING:
    import argparse


class MorePhotos(Part):
    """Finds the photos that a checkpoint has not seen, and lets every second iteration train on one of them at first.

    Checkpoints from then on keep which these were, so that a resumed training has the same order of views.
    """

    name = "more_photos"
    by_state = True  # also where torchrun restarts a training, which names no checkpoint

    @classmethod
    def wanted(cls, given: "argparse.Namespace") -> bool:
        return bool(getattr(given, "start_checkpoint", None))

    def begin(self, run: Any, state: Any) -> None:
        from splatting.parts.more_photos_order import Added, added_order, new_photos

        found = new_photos(run)
        if found:
            self._refuse_folder(run)
            fill(run, "has_new_photos", True, self)
            added = Added.at(run.first_iteration, run.schedule.ends, found, run.views.cameras)
            print(f"{len(found)} photos are new; until iteration {added.until} every second one trains on one of them")
        else:
            added = None if state is None else Added.restored(state)
        self.active = added is not None
        if added is not None:
            self._added = added
            fill(run, "views", added_order(run.views, added), self)

    @staticmethod
    def _refuse_folder(run: Any) -> None:
        """The folder keeps which photos its checkpoints have seen, so it may not get others."""
        from splatting.training.folder import lies_in

        if lies_in(run.start, run.dataset.model_path):
            raise UserError(
                f"{run.dataset.source_path} has photos that {run.start} was not trained on; give --start_checkpoint "
                f"{run.start} and name another folder by -m, as this one keeps the model without them"
            )

    def state(self) -> dict[str, Any]:
        return self._added._asdict()
