"""Obstacles of a page's guests: the octree, read by the description of its form, and where a floor and walls are."""

import json
import re

import numpy as np
import pytest
from gaussians import pipeline
from room_scene import HALF, HIGH, STEP, cameras, room

from applications.export.upright import move_splats
from applications.export.walking import LEAF, SOLID, Solid, encode_octree, make_solid, measure_metre
from groundwork.files.similarity import Similarity
from utils.system_utils import UserError


def solid_at(solid: Solid, places: np.ndarray) -> list[bool]:
    """Tell for each point (N, 3) of the viewer's world whether it is solid."""
    about, words = json.loads(solid.about), np.frombuffer(solid.content, "<u4")
    nodes, masks = words[: about["nodeCount"]].tolist(), words[about["nodeCount"] :].tolist()
    assert len(masks) == about["leafDataCount"]
    low, high = (np.array(about["gridBounds"][end]) for end in ("min", "max"))
    found = []
    for voxel in np.floor((places - low) / about["voxelResolution"]).astype(int):
        inside = (voxel >= 0).all() and (voxel < np.rint((high - low) / about["voxelResolution"])).all()
        found.append(bool(inside) and _solid(nodes, masks, voxel.tolist(), about["treeDepth"]))
    return found


def _solid(nodes: list[int], masks: list[int], voxel: list[int], depth: int) -> bool:
    node = nodes[0]
    for level in reversed(range(depth)):
        if node == SOLID:
            return True
        mask, octant = node >> 24, sum((v // LEAF >> level & 1) << axis for axis, v in enumerate(voxel))
        if not mask >> octant & 1:
            return False
        node = nodes[(node & 0xFFFFFF) + (mask & (1 << octant) - 1).bit_count()]
    bit = sum((v % LEAF) * LEAF**axis for axis, v in enumerate(voxel))
    return node == SOLID or bool(masks[2 * node + bit // 32] >> bit % 32 & 1)


def test_an_octree_has_the_voxels_that_it_was_made_of():
    rng = np.random.default_rng(0)
    block = np.stack(np.meshgrid(*[np.arange(8, 16)] * 3, indexing="ij"), -1).reshape(-1, 3)  # leaves that are full
    voxels = np.unique(np.concatenate([rng.integers(-20, 40, (500, 3)), block]), axis=0)
    every = np.stack(np.meshgrid(*[np.arange(-24, 44)] * 3, indexing="ij"), -1).reshape(-1, 3)
    tried = np.concatenate([voxels, every[rng.choice(len(every), 3000, replace=False)]])
    there = {tuple(voxel) for voxel in voxels.tolist()}
    assert solid_at(encode_octree(voxels, 0.1), 0.1 * tried) == [tuple(voxel) in there for voxel in tried.tolist()]
    one = encode_octree(np.array([[3, 4, 5]]), 0.1)
    assert solid_at(one, np.array([[0.3, 0.4, 0.5], [0.5, 0.4, 0.5]])) == [True, False]


def test_a_room_is_solid_at_its_walls_floor_and_step_alone():
    solid = make_solid(room(), cameras(), pipeline())
    around = np.array([(x, y, z) for x in (-2, 2) for y in (0.6, 2) for z in (-2, 0, 2)], float)
    free = [*around, (0, 0.1, 0), (0, STEP[0] + 0.1, 2), (HALF - 0.15, 1, 0)]
    full = [(0, -0.05, 0), (0, STEP[0] - 0.07, 2), (HALF + 0.07, 1, 0), (-HALF - 0.07, 1, 0), (0, HIGH + 0.07, -1)]
    assert solid_at(solid, np.array([*free, *full])) == [False] * len(free) + [True] * len(full)


def test_nobody_walks_where_photos_show_a_small_thing(capsys):
    small = Similarity(np.eye(3), 0.5, np.zeros(3))  # 3 metres wide
    assert make_solid(move_splats(room(), small), cameras(unit=0.5), pipeline()) is None
    said = r"the photos show 3\.\d x 3\.\d metres, too small to walk in; guests can walk in 5 x 5 or more"
    assert re.search(said, capsys.readouterr().out)


def test_cameras_of_an_unknown_unit_stand_at_the_height_of_eyes():
    hundreds = move_splats(room(), Similarity(np.eye(3), 0.01, np.zeros(3)))
    assert measure_metre(hundreds, cameras(unit=0.01)) == pytest.approx(100, rel=0.05)
    with pytest.raises(UserError, match="--walk needs photos that look at a floor"):
        measure_metre(room(), cameras(height=-1.5))
