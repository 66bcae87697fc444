"""Agreement of a model with the pairs that it was made from, and the ways in which photos are mapped."""

import json
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from photo_room import cam_to_world, camera_centers
from scipy.optimize import minimize

from applications.convert import mapping
from applications.convert.checks import is_wrong
from scene import agreement
from scene.checks.fit import check_agreement
from scene.epipolar import epipolar_angles, matrix_angles
from utils.system_utils import UserError

COUNT, POINTS = 12, 200


def _room(moved: dict[int, np.ndarray] | None = None, noise: float = 0.2) -> pycolmap.Reconstruction:
    """Photos of random points, with noisy observations (pixels); moved: by number of photo, how far it is put away."""
    rng = np.random.default_rng(0)
    model, camera = pycolmap.Reconstruction(), pycolmap.Camera(
        model="PINHOLE", width=800, height=600, params=[700.0, 700.0, 400.0, 300.0], camera_id=1
    )  # fmt: skip
    model.add_camera_with_trivial_rig(camera)
    points = rng.uniform(-0.8, 0.8, (POINTS, 3)) + [0, 0, 0.6]
    tracks = [pycolmap.Track() for _ in points]
    for number, center in enumerate(camera_centers(COUNT)):
        turn = pycolmap.Rotation3d(cam_to_world(center).T)
        seen = camera.img_from_cam((cam_to_world(center).T @ (points - center).T).T)
        seen = np.asarray(seen) + noise * rng.normal(size=(POINTS, 2))
        center = center + (moved or {}).get(number, 0.0)
        pose = pycolmap.Rigid3d(turn, -(turn.matrix() @ center))
        image = pycolmap.Image(name=f"{number:02d}.jpg", keypoints=seen, camera_id=1, image_id=number + 1)
        model.add_image_with_trivial_frame(image, pose)
        for place, track in enumerate(tracks):
            track.add_element(number + 1, place)
    for point, track in zip(points, tracks, strict=True):
        model.add_point3D(point, track, np.zeros(3, np.uint8))
    return model


def test_angles_are_the_least_by_which_both_rays_must_turn():
    """To first order, by SciPy; for rays in all directions, as panoramas have them."""
    rng = np.random.default_rng(0)
    essential = np.array([[0, -0.3, 0.2], [0.3, 0, -1.0], [-0.2, 1.0, 0]])
    rays = _unit(rng.normal(size=(8, 3)))
    planes = _unit(rays @ essential.T)
    seen = _unit(np.cross(planes, rng.normal(size=(8, 3))) + 1e-3 * planes)

    def turned(by: np.ndarray, one: np.ndarray, other: np.ndarray) -> float:
        first, second = (
            _unit((ray + np.cross(turn, ray))[None])[0]
            for ray, turn in zip((one, other), (by[:3], by[3:]), strict=True)
        )
        return second @ essential @ first

    angles = np.abs(matrix_angles(essential[None], rays[None], seen[None])[0][0])
    shift = np.array([1.0, 0.2, 0.3]) / np.linalg.norm([1.0, 0.2, 0.3])
    np.testing.assert_allclose(np.abs(epipolar_angles(shift, rays, seen)[0]), angles, rtol=1e-9)
    for one, other, found in zip(rays, seen, angles, strict=True):
        met = {"type": "eq", "fun": turned, "args": (one, other)}
        best = minimize(lambda by: by @ by, np.full(6, 1e-4), constraints=[met], tol=1e-14)
        assert best.success and found == pytest.approx(np.sqrt(best.fun), rel=0.01)


def _unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def test_a_photo_in_a_wrong_place_is_named():
    found = agreement.verdict([*agreement.judge_pairs_by_tracks(_room())])
    assert (found["agreeing"], found["contradicting"], found["against"]) == (COUNT, 0, [])
    found = agreement.verdict([*agreement.judge_pairs_by_tracks(_room({5: np.array([0.1, -0.1, 0.2])}))])
    assert found["against"] == ["05.jpg"] and found["agreeing"] == COUNT - 1


def test_a_part_in_a_wrong_place_is_named_although_it_agrees_with_itself():
    aside = dict.fromkeys(range(8, COUNT), np.array([0.3, 0.2, 0.4]))
    found = agreement.verdict([*agreement.judge_pairs_by_tracks(_room(aside))])
    assert found["against"] == [f"{number:02d}.jpg" for number in range(8, COUNT)] and found["agreeing"] == 8


def test_the_doctor_names_a_model_whose_tracks_contradict_each_other(tmp_path):
    for name, moved in (("right", {}), ("wrong", dict.fromkeys(range(8, COUNT), np.array([0.3, 0.2, 0.4])))):
        (tmp_path / name).mkdir()
        _room(moved).write(str(tmp_path / name))
        (line,) = check_agreement(tmp_path / name)
        assert line.is_problem == (name == "wrong")
        assert f"the tracks of {8 if moved else COUNT} of {COUNT} photos agree with each other" in line.text
    assert not [*check_agreement(tmp_path / "nothing")]


def test_an_order_that_is_turned_contradicts_though_its_epipolar_planes_fit():
    model = _room(noise=0.0)
    one, other = (model.images[number] for number in (1, 2))
    rays = [
        _unit(np.asarray(model.cameras[1].cam_ray_from_img(np.array([p.xy for p in i.points2D])))) for i in (one, other)
    ]
    assert [pair.behind for pair in agreement.judge_rays([(one, other, *rays)])] == [0]
    assert [pair.behind for pair in agreement.judge_rays([(one, other, *(-part for part in rays))])] == [1]
    assert _pair("a", "b")._replace(behind=0.9).contradicts and not _pair("a", "b")._replace(behind=0.5).contradicts


def _pair(one: str, other: str, wrong: bool = False, matches: int = 50) -> agreement.Pair:
    return agreement.Pair(one, other, matches, 9.0 if wrong else 0.1, 0.1, 800)


def test_groups_are_those_between_which_pairs_contradict():
    chain = [(a, b, 50) for a, b in ("ab", "bc", "ac", "de", "ef", "df")]
    groups = agreement.consistent_groups([*chain, ("c", "d", -50), ("a", "f", 20)])
    assert [sorted(group) for group in groups] == [[*"abc"], [*"def"]]
    groups = agreement.consistent_groups([*chain, ("c", "d", -50), ("a", "f", 60)])
    assert [sorted(group) for group in groups] == [[*"abcdef"]]
    # Hundreds of matches of two photos that show nearly the same do not outvote several other pairs.
    pairs = [_pair(a, b) for a, b, _ in chain] + [_pair("a", "d", matches=900)]
    pairs += [_pair(a, b, wrong=True) for a, b in ("bd", "cd", "be")]
    assert agreement.verdict(pairs)["agreeing"] == 4


def test_pairs_of_a_database_judge_a_model(tmp_path):
    """Only photos with a pose in the model are asked, and only pairs of known focal lengths."""
    model, path = _room(), str(tmp_path / "database.db")
    database = pycolmap.Database.open(path)
    database.write_camera(model.cameras[1], use_camera_id=True)
    database.write_rig(model.rigs[1], use_rig_id=True)
    for number, image in sorted(model.images.items()):
        database.write_frame(model.frames[number], use_frame_id=True)
        database.write_image(image, use_image_id=True)
        database.write_keypoints(number, np.array([point.xy for point in image.points2D], np.float32))
    same = np.repeat(np.arange(POINTS, dtype=np.uint32)[:, None], 2, axis=1)
    for one in range(1, COUNT + 1):
        for other in range(one + 1, COUNT + 1):
            kind = pycolmap.TwoViewGeometryConfiguration
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = kind.UNCALIBRATED if other == one + 1 else kind.CALIBRATED
            geometry.inlier_matches = same[:POINTS]
            database.write_two_view_geometry(one, other, geometry)
    database.close()
    wrong = _room({5: np.array([0.1, -0.1, 0.2])})
    wrong.deregister_frame(wrong.images[1].frame_id)
    found = agreement.judge(wrong, path)
    assert (found["pairs"], found["agreeing"], found["bound"]) == (10 * 9 // 2, COUNT - 2, COUNT)
    assert found["against"] == ["05.jpg"]


def _mapped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, agreeing: dict[str, int], **found: object) -> tuple:
    """Map photos in ways that end with that many agreeing photos; return the ways, the judgements, the photos left out.

    found: what the judgement finds besides.
    """
    work, done, left_out = tmp_path / "distorted", [], []
    layout = SimpleNamespace(
        database=work / "a.db", calibrated=work / "b.db", tried=work / "tried", models=work / "sparse", work=work,
        judged=work / "judged.json",
    )  # fmt: skip
    work.mkdir()
    backend = SimpleNamespace(
        layout=layout, settings=SimpleNamespace(mapper="auto"),
        ways=("direct", "grown", "global", "incremental", "free"),
        calibration=lambda: [], mapping=lambda way, models, **job: [(way, models, job)],
    )  # fmt: skip

    def place(_: str, commands: list[tuple[str, Path, dict]]) -> None:
        ((way, models, job),) = commands
        assert ("base" in job) == (way == "grown")
        done.append(way)
        if way not in agreeing:
            raise UserError("no such way")
        (models / "0").mkdir(parents=True)
        (models / "0" / way).touch()

    def run(commands: list, title: str) -> None:
        if title == "Judging":
            right = {"folder": "0", "pairs": 99, "agreeing": agreeing[done[-1]], "contradicting": 0.01, "against": []}
            right |= {"error": 0.1, "own_error": 0.1} | found
            (work / "judging.json").write_text(json.dumps(right | {"left": right}))
        elif title == "Leaving out photos":
            left_out.extend(json.loads(Path(commands[0][2]).read_text())["left_out"])

    monkeypatch.setattr(mapping, "copy_database", lambda *_: None)
    monkeypatch.setattr(mapping, "count_rows", lambda *_: found["photos"])
    mapping.map_photos(backend, run, place)
    judged = json.loads(layout.judged.read_text())
    assert (layout.models / "0" / judged[0]["way"]).is_file() and not layout.tried.exists()
    return done, judged, left_out


@pytest.mark.parametrize(
    ("count", "agreeing", "found", "tried", "kept"),
    [
        (20, {"incremental": 20}, {}, ["incremental"], "incremental"),
        (20, {"incremental": 12, "direct": 19}, {}, ["incremental", "direct"], "direct"),
        (50, {"direct": 50}, {}, ["direct"], "direct"),
        (50, {"incremental": 50}, {}, ["direct", "incremental"], "incremental"),
        (50, {"incremental": 12, "global": 49}, {}, ["direct", "incremental", "global"], "global"),
        (90, {"global": 90}, {}, ["direct", "global"], "global"),
        (90, {"direct": 60, "grown": 85}, {"against": ["7.jpg"]}, ["direct", "grown"], "grown"),
        (90, {"direct": 9, "global": 50, "incremental": 70, "free": 60}, {},
         ["direct", "global", "incremental", "free"], "incremental"),
    ],
)  # fmt: skip
def test_ways_are_tried_until_one_agrees(tmp_path, monkeypatch, capsys, count, agreeing, found, tried, kept):
    done, judged, _ = _mapped(tmp_path, monkeypatch, agreeing, photos=count, bound=count, **found)
    assert done == tried and judged[0]["way"] == kept and len(judged) == len(tried)
    assert capsys.readouterr().out.count("; trying ") == len(tried) - 1


@pytest.mark.parametrize(
    ("found", "tried", "left_out"),
    [
        ({"alike": ["7.jpg"]}, 1, ["7.jpg"]),  # one photo among those of another thing is left out
        ({"alike": ["7.jpg", "8.jpg", "9.jpg"], "alike_pair": ["7.jpg", "1.jpg"]}, 2, []),  # parts upon each other
        ({"rotation": 0.002}, 1, []),  # no way places a camera that only turned
    ],
)
def test_pairs_that_mislead(tmp_path, monkeypatch, found, tried, left_out):
    agreeing = dict.fromkeys(("direct", "global", "incremental", "free"), 20)
    done, judged, out = _mapped(tmp_path, monkeypatch, agreeing, photos=20, bound=20, **found)
    assert len(done) == tried and out == left_out and is_wrong(judged[0]) == (not left_out)


def test_a_small_model_beside_a_folded_one_is_not_trusted():
    folded = {"photos": 24, "pairs": 99, "agreeing": 14, "contradicting": 0.04, "alike": ["1", "2"]}
    small = folded | {"photos": 14, "alike": []}
    large = folded | {"photos": 22, "agreeing": 22, "alike": []}
    assert max([folded, small], key=partial(mapping._rank_model, [folded, small])) is folded
    assert max([folded, large], key=partial(mapping._rank_model, [folded, large])) is large


def test_when_a_model_is_called_wrong():
    right = {"pairs": 90, "contradicting": 0.05, "agreeing": 40, "photos": 42, "bound": 42}
    assert mapping.is_accepted(right) and not is_wrong(right)
    assert not mapping.is_accepted(right | {"agreeing": 30}) and not is_wrong(right | {"agreeing": 30})
    assert is_wrong(right | {"agreeing": 20}) and is_wrong(right | {"contradicting": 0.3})
    assert not is_wrong({"pairs": 0}) and not mapping.is_accepted({})  # nothing to judge by
