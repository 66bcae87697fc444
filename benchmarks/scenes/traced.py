"""The ray-traced sets of captures.py, things and cameras: sound captures, a video, and some that mislead matching."""

from functools import partial
from typing import NamedTuple

import numpy as np

from applications.demo.objects import Box, Sphere, Thing, demo_scene, marble
from applications.demo.tracer import TARGET, View, look_at

_DOOR, _DOORS, _WIDE, _HIGH = 2.0, 24, 1.2, 2.5  # of the corridor, in units; from the middle to a wall
_APART = 100.0  # from one room with the poster to the other
_MARKED = 4  # every so many doors have a mark beside them
_ROOMS = Box((0, -1.25, 0), (2.5, 1.25, 2), 0), Box((5.5, -1.25, 0.2), (2.5, 1.25, 2.2), 0)
_PASSAGE = Box((2.75, -1, 0), (0.5, 1, 0.5), 0)


def grain(p: np.ndarray, seed: int) -> np.ndarray:
    """Colours (3, R) at points (3, R), with details of many sizes, as features need them."""
    rng, total = np.random.default_rng(seed), np.zeros(p.shape, np.float32)
    for weight, scale in ((0.4, 1.0), (0.35, 2.3), (0.25, 5.5)):
        light, dark = (rng.uniform(*of, (3, 1)).astype(np.float32) for of in ((0.6, 1.0), (0.0, 0.4)))
        total += np.float32(weight) * marble(light, dark, int(rng.integers(1000)))(np.float32(scale) * p)
    return total


def _color_corridor(p: np.ndarray) -> np.ndarray:
    """Walls that repeat from door to door, with a mark at some; the ends are bare."""
    x, y, z = p
    place = np.floor(z / np.float32(_DOOR))
    within = z - np.float32(_DOOR) * place
    same = np.stack([x, y, within])
    colour = np.float32(0.45) + np.float32(0.5) * grain(same, 1)
    wall = np.abs(x) > _WIDE - 1e-3
    aside, high = np.abs(within - 1), -y
    frame = wall & (aside < 0.55) & (high < 2.15)
    door = wall & (aside < 0.45) & (high < 2.05)
    colour = np.where(frame, np.float32(0.25), colour)
    colour = np.where(door, np.float32([[0.6], [0.4], [0.25]]) * (np.float32(0.4) + grain(same, 2)), colour)
    mark = wall & (place % _MARKED == 0) & (np.abs(within - 1.8) < 0.15) & (np.abs(high - 1.5) < 0.2)
    colour = np.where(mark, grain(np.float32(3) * p, 3), colour)
    return np.where((z < 1e-3) | (z > _DOOR * _DOORS - 1e-3), np.float32(0.8), colour)


def corridor(_: int | None = None) -> list[Thing]:
    """A tunnel of equal doors."""
    half = _DOOR * _DOORS / 2
    return [Thing(Box((0, -_HIGH / 2, half), (_WIDE, _HIGH / 2, half), 0), _color_corridor, emissive=True)]


def corridor_views(width: int, height: int) -> list[View]:
    """Sixty cameras that walk along the corridor and look ahead and to the right."""
    rng, views = np.random.default_rng(1), []
    for k in range(60):
        center = np.array([rng.uniform(-0.3, 0.1), rng.uniform(-1.6, -1.4), 2.0 + 0.6 * k + rng.uniform(-0.05, 0.05)])
        turn = np.radians(35 + rng.uniform(-6, 6))
        target = center + [np.sin(turn), rng.uniform(-0.05, 0.1), np.cos(turn)]
        views.append(View(look_at(center, target), center, 0.8 * width, width, height))
    return views


class Hollow(NamedTuple):
    """The surface around boxes that overlap, for rays that begin in one of them."""

    boxes: tuple[Box, ...]

    def intersect(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Distances (R,) at which rays leave the last box; as `applications.demo.objects` has it."""
        end = np.zeros(direction.shape[1], np.float32)
        for box in self.boxes * len(self.boxes):
            leave = box.intersect(origin + end * direction, direction)
            inside = (np.abs(box.local(origin + end * direction)) < 1 + 1e-4).all(0)
            end = np.where(inside & np.isfinite(leave), end + leave, end)
        return np.where(end > 0, end, np.float32(np.inf))


def _color_rooms(p: np.ndarray) -> np.ndarray:
    """Walls of other colours in each room."""
    return np.where(p[0] < _PASSAGE.center[0], grain(p, 4), grain(p, 6))


def rooms(_: int | None = None) -> list[Thing]:
    """Two rooms with furniture at their walls, and a door between them."""
    rng, things = np.random.default_rng(2), []
    things.append(Thing(Hollow((*_ROOMS, _PASSAGE)), _color_rooms, emissive=True))
    for k, room in enumerate(_ROOMS):
        low = rng.uniform(0.2, 0.3)
        places = [(-1.9, -1.4), (-0.8, 1.5), (0.5, -1.5), (1.7, 1.4), (-1.8, 1.4), (1.6, -1.5)]
        for number, (x, z) in enumerate(places):
            x, z, seed = room.center[0] + x, room.center[2] + z, 10 * k + number + 10
            if number % 3 == 2:
                shape = Sphere((x, -0.35, z), 0.35)
            else:
                high = rng.uniform(0.3, 0.8)
                shape = Box((x, -high, z), (0.4, high, 0.3), rng.uniform(-0.4, 0.4))
            things.append(Thing(shape, lambda p, seed=seed: grain(p, seed)))
        table = Box((room.center[0], -low, room.center[2]), (0.5, low, 0.3), 0.2)
        things.append(Thing(table, lambda p, k=k: grain(p, 40 + k)))
    return things


def rooms_views(width: int, height: int) -> list[View]:
    """Forty cameras in each room, which look across it, and ten on the way through the door."""
    rng, views = np.random.default_rng(3), []

    def add(center: np.ndarray, target: np.ndarray) -> None:
        center, target = center + rng.uniform(-0.05, 0.05, 3), target + rng.uniform(-0.1, 0.1, 3)
        views.append(View(look_at(center, target), center, 0.7 * width, width, height))

    def around(room: Box) -> None:
        middle = np.array([room.center[0], -1.3, room.center[2]])
        for angle in 2 * np.pi * np.arange(40) / 40:
            out = np.array([1.5 * np.cos(angle), 0, 0.7 * np.sin(angle)])
            add(middle + out, middle - out + [0, 0.3, 0])

    around(_ROOMS[0])
    for x in np.linspace(-1.0, 5.0, 10):
        add(np.array([x, -1.3, 0]), np.array([x + 2, -1.2, 0.05]))
    around(_ROOMS[1])
    return views


def ring(count: int, width: int, height: int) -> list[View]:
    """Cameras around the demo's things, at heights that rise and fall; the last one stands before the first."""
    views = []
    for angle in 2 * np.pi * np.arange(count) / count:
        tilt = np.radians(24 + 8 * np.sin(2 * angle))
        out = np.array([np.cos(tilt) * np.sin(angle), -np.sin(tilt), np.cos(tilt) * np.cos(angle)])
        center = TARGET + 3.8 * out
        views.append(View(look_at(center, TARGET), center, 0.9 * width, width, height))
    return views


def turntable_views(width: int, height: int) -> list[View]:
    """Forty cameras around the turntable."""
    return ring(40, width, height)


def turntable(photo: int | None) -> list[Thing]:
    """The demo's things without sky and ground; in a photo, before a wall that turns with its camera."""
    things = demo_scene()[2:]
    if photo is None:
        return things
    view = turntable_views(1, 1)[photo]

    def still(p: np.ndarray) -> np.ndarray:
        local = view.rotation.astype(np.float32) @ (p - view.center.astype(np.float32)[:, None])
        return grain(np.float32(5) * local / np.maximum(local[2], np.float32(1)), 5)

    return [Thing(Sphere(tuple(view.center), 20.0, inside=True), still, emissive=True), *things]


def demo(_: int | None) -> list[Thing]:
    """The demo's things, once for each photo."""
    return demo_scene()


def video_views(width: int, height: int) -> list[View]:
    """The cameras of a video's frames, once around."""
    return ring(300, width, height)


def one_room(_: int | None = None) -> list[Thing]:
    """A bare room with walls of one texture."""
    return [Thing(_ROOMS[0], lambda p: grain(p, 4), emissive=True)]


def turning_views(noise: float, width: int, height: int) -> list[View]:
    """Eighteen cameras in the middle of the room that look around. noise: standard deviation of their places, units."""
    rng, views = np.random.default_rng(5), []
    for k in range(18):
        center, turn = np.array([0.2, -1.3, 0.1]) + noise * rng.standard_normal(3), np.radians(20 * k)
        target = center + [np.sin(turn), rng.uniform(-0.1, 0.1), np.cos(turn)]
        views.append(View(look_at(center, target), center, 0.6 * width, width, height))
    return views


def poster(_: int | None = None) -> list[Thing]:
    """Two rooms with walls of their own and the same poster on one wall each."""

    def walls(p: np.ndarray, seed: int) -> np.ndarray:
        on_poster = (p[2] > _ROOMS[0].half[2] - 1e-3) & (np.abs(p[0]) < 0.8) & (p[1] < -0.6) & (p[1] > -2.0)
        return np.where(on_poster, grain(np.float32(1.5) * p, 8), grain(p, seed))

    first, away = _ROOMS[0], np.float32([[_APART], [0], [0]])
    second = Box((_APART, *first.center[1:]), first.half, 0)
    return [
        Thing(first, lambda p: walls(p, 4), emissive=True),
        Thing(second, lambda p: walls(p - away, 6), emissive=True),
    ]


def poster_views(width: int, height: int) -> list[View]:
    """Ten cameras in each room, which look at the poster and the walls beside it."""
    rng, views = np.random.default_rng(6), []
    for room in (0.0, _APART):
        for k in range(10):
            center = np.array([room - 1.6 + 0.35 * k, rng.uniform(-1.5, -1.1), rng.uniform(-1.2, -0.6)])
            target = np.array([room + rng.uniform(-0.8, 0.8), -1.3, 2.0])
            views.append(View(look_at(center, target), center, 0.7 * width, width, height))
    return views


def twin_box(_: int | None = None) -> list[Thing]:
    """A box on black whose front and back are alike."""
    half = 1.0, 0.8, 0.7

    def faces(p: np.ndarray) -> np.ndarray:
        on_end = np.abs(p[2]) > half[2] - 1e-3
        same = np.stack([p[0] * np.sign(p[2]), p[1], np.abs(p[2])])
        return grain(np.where(on_end, same, p), 9)

    black = Thing(Sphere((0, 0, 0), 30.0, inside=True), np.zeros_like, emissive=True)
    return [black, Thing(Box((0, 0, 0), half, 0), faces, emissive=True)]


def twin_box_views(width: int, height: int) -> list[View]:
    """Thirty-six cameras around the box."""
    rng, views = np.random.default_rng(7), []
    for angle in 2 * np.pi * np.arange(36) / 36:
        center = np.array([4 * np.sin(angle), rng.uniform(-1.2, -0.4), 4 * np.cos(angle)])
        views.append(View(look_at(center, np.zeros(3)), center, 1.1 * width, width, height))
    return views


TRACED = {
    **{f"turning{round(100 * noise)}": (partial(turning_views, noise), one_room) for noise in (0.0, 0.01, 0.03, 0.3)},
    "poster": (poster_views, poster),
    "twin_box": (twin_box_views, twin_box),
    "corridor": (corridor_views, corridor),
    "rooms": (rooms_views, rooms),
    "turntable": (turntable_views, turntable),
    "video": (video_views, demo),
}
