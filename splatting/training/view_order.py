"""Order in which training cameras are shown."""

from scene.cameras import Camera
from splatting.deterministic.counter_rng import Stream, permutation
from utils.system_utils import UserError


class ViewOrder:
    """Training cameras by iteration, counted from 1: each once per epoch, in an order drawn from seed and epoch.

    batch: views of an iteration, one for each rank; place: of this rank's view among them.
    """

    def __init__(self, cameras: list[Camera], seed: int, batch: int = 1, place: int = 0) -> None:
        if not cameras:
            raise UserError("the scene has no training views; without --eval all views train")
        self._cameras = cameras
        self._seed = seed
        self._batch, self._place = batch, place
        self._orders: dict[int, list[int]] = {}

    def numbers(self, iteration: int) -> range:
        """The views of an iteration, as they are counted from 1 over all iterations."""
        return range((iteration - 1) * self._batch + 1, iteration * self._batch + 1)

    def own(self, iteration: int) -> int:
        """The one of these that this rank shows."""
        return self.numbers(iteration)[self._place]

    def of(self, number: int) -> Camera:
        """The camera of a view, by its number."""
        epoch, position = divmod(number - 1, len(self._cameras))
        if epoch not in self._orders:
            # Two at most: prefetching at the end of an epoch alternates between it and the next.
            order = permutation(self._seed, Stream.VIEW_ORDER, epoch, len(self._cameras))
            self._orders = {epoch: order} | {e: o for e, o in self._orders.items() if e == epoch - 1}
        return self._cameras[self._orders[epoch][position]]

    def __getitem__(self, iteration: int) -> Camera:
        return self.of(self.own(iteration))

    def coming(self, iteration: int, count: int) -> list[Camera]:
        """The cameras of `count` iterations, this one first; at most one epoch of them."""
        return [self[t] for t in range(iteration, iteration + min(count, len(self._cameras)))]
