"""A browser's stand-in that orbits for some seconds, then moves once at a time. frames.py and share.py run it.

    python -m benchmarks.viewing.browser URL [--seconds 5] [--rate 60] [--size 1280 720] [--once 20]

Prints JSON: `pictures` and `seconds` of the orbit, the shape of the `first` one, and `round_trips`, the seconds from a
movement that was sent to the picture that arrived.
"""

import argparse
import contextlib
import json
import math
import threading
import time

import numpy as np
from websockets.exceptions import ConnectionClosed

from benchmarks.workloads.viser_client import Client


class Orbit:
    """Poses on a small circle around where the page begins. fov: vertical, radians."""

    def __init__(self, client: Client, size: tuple[int, int]) -> None:
        self._client, self._size, self._taken = client, size, 0
        given: dict[str, list[float]] = {}
        kinds = {"SetCameraPositionMessage": "position", "SetCameraLookAtMessage": "look_at"}
        kinds["SetCameraUpDirectionMessage"] = "up"
        while len(given) < len(kinds):
            for message in client.messages():
                if name := kinds.get(message["type"]):
                    given[name] = next(value for value in message.values() if isinstance(value, list))
        self._from, self._at, self._up = (np.array(given[name]) for name in ("position", "look_at", "up"))

    def move(self) -> None:
        """Send the next pose."""
        self._taken += 1
        right = np.cross(self._at - self._from, self._up)
        angle = 0.02 * self._taken
        place = self._from + 0.1 * (math.sin(angle) * right + (math.cos(angle) - 1) * np.cross(right, self._up))
        forward = (self._at - place) / np.linalg.norm(self._at - place)
        right = np.cross(forward, self._up)
        right /= np.linalg.norm(right)
        turn = np.stack([right, np.cross(forward, right), forward], axis=1)
        self._client.look(place, _quaternion(turn), 0.9, self._size)


def _quaternion(turn: np.ndarray) -> list[float]:
    """Unit quaternion wxyz of a rotation matrix, by the largest of its four squares (Shepperd 1978)."""
    m, trace = turn, np.trace(turn)
    squares = [trace, *np.diag(m)]
    first = int(np.argmax(squares))
    wxyz = np.zeros(4)
    wxyz[first] = 1 + 2 * squares[first] - trace
    pairs = {(0, 1): m[2, 1] - m[1, 2], (0, 2): m[0, 2] - m[2, 0], (0, 3): m[1, 0] - m[0, 1]}
    pairs |= {(1, 2): m[0, 1] + m[1, 0], (1, 3): m[0, 2] + m[2, 0], (2, 3): m[1, 2] + m[2, 1]}
    for pair, value in pairs.items():
        if first in pair:
            wxyz[sum(pair) - first] = value
    return (wxyz / np.linalg.norm(wxyz)).tolist()


def watch(url: str, seconds: float, rate: float, size: tuple[int, int], once: int) -> dict[str, object]:
    """What the module's docstring says. rate: movements a second, 0: the camera stands still."""
    with Client(url) as client:
        orbit = Orbit(client, size)
        orbit.move()
        shape = client.picture(60.0).shape
        begin, done = time.perf_counter(), threading.Event()

        def keep_moving() -> None:
            with contextlib.suppress(ConnectionClosed):
                while rate and not done.wait(1 / rate):
                    orbit.move()

        mover = threading.Thread(target=keep_moving)
        mover.start()
        pictures = 0
        while (left := begin + seconds - time.perf_counter()) > 0:
            try:
                client.picture(left)
                pictures += 1
            except (TimeoutError, ConnectionClosed):  # of a training that is done
                break
        taken = time.perf_counter() - begin
        done.set()
        mover.join()
        return {"pictures": pictures, "seconds": taken, "first": shape, "round_trips": _once(client, orbit, once)}


def _once(client: Client, orbit: Orbit, count: int) -> list[float]:
    """Seconds from each of some movements to its first picture."""
    trips = []
    for _ in range(count):
        try:
            while True:  # what belongs to the movement before
                client.picture(0.6)
        except TimeoutError:
            pass
        sent = time.perf_counter()
        orbit.move()
        client.picture(60.0)
        trips.append(time.perf_counter() - sent)
    return trips


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("url", help="address of the page")
    parser.add_argument("--seconds", type=float, default=5.0, help="length of the orbit (default: 5)")
    parser.add_argument("--rate", type=float, default=60.0, help="movements a second, 0: none (default: 60)")
    parser.add_argument("--size", type=int, nargs=2, default=(1280, 720), metavar=("W", "H"), help="of the window")
    parser.add_argument("--once", type=int, default=20, help="single movements after the orbit (default: 20)")
    args = parser.parse_args()
    print(json.dumps(watch(args.url, args.seconds, args.rate, tuple(args.size), args.once)))


if __name__ == "__main__":
    main()
