"""Order in which training cameras are shown."""

from scene.cameras import Camera
from utils.exact.counter_rng import Stream, permutation
from utils.system_utils import UserError


class ViewOrder:
    """Training cameras by iteration, counted from 1: each once per epoch, in an order drawn from seed and epoch."""

    def __init__(self, cameras: list[Camera], seed: int) -> None:
        if not cameras:
            raise UserError("the scene has no training views; without --eval all views train")
        self._cameras = cameras
        self._seed = seed
        self._orders: dict[int, list[int]] = {}

    def __getitem__(self, iteration: int) -> Camera:
        epoch, position = divmod(iteration - 1, len(self._cameras))
        if epoch not in self._orders:
            # Two at most: prefetching at the end of an epoch alternates between it and the next.
            order = permutation(self._seed, Stream.VIEW_ORDER, epoch, len(self._cameras))
            self._orders = {epoch: order} | {e: o for e, o in self._orders.items() if e == epoch - 1}
        return self._cameras[self._orders[epoch][position]]

    def coming(self, iteration: int, count: int) -> list[Camera]:
        """The cameras of `count` iterations, this one first; at most one epoch of them."""
        return [self[t] for t in range(iteration, iteration + min(count, len(self._cameras)))]
