"""Photos that --holdout sector and block hold out, and what they refuse."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import edit_json, make_blender_scene, make_nerfstudio_scene, read
from trainings import train_on

from applications.evaluation.results import _split_views
from scene.readers.holdout import split
from scene.readers.info import CameraInfo
from utils.graphics_utils import focal2fov
from utils.system_utils import UserError


def camera(name: str, place: np.ndarray, forward: np.ndarray, frame: Rotation) -> CameraInfo:
    """Looks along `forward` with its head towards z; a frame turns the whole world."""
    right = np.cross(forward, (0.0, 0.0, 1.0))
    turn = np.column_stack([right, np.cross(forward, right), forward])
    R, center = frame.as_matrix() @ (turn / np.linalg.norm(turn, axis=0)), frame.apply(place)
    fov = focal2fov(50, 40)
    return CameraInfo(0, R, -R.T @ center, fov, fov, image_name=name, width=40, height=40)


def ring(degrees: list[float], frame: Rotation | None = None, sign: float = -1.0) -> list[CameraInfo]:
    """Around (5, 0, 1) in two heights and distances, all angles in the lower one first; sign -1: looking inward."""
    cameras = []
    for level, (radius, height) in enumerate(((3.0, 0.5), (2.0, 2.0))):
        for number, angle in enumerate(np.radians(degrees)):
            arm = np.array([np.cos(angle), np.sin(angle), 0.0])
            forward = sign * radius * arm + (0, 0, -height)
            place = radius * arm + (5, 0, 1 + height)
            cameras.append(camera(f"{level}_{number:02d}", place, forward, frame or Rotation.identity()))
    return cameras


def names(cameras: list[CameraInfo], rule: str) -> list[str]:
    train, test = split(cameras, True, rule, Path("scene"))
    assert [one.image_name for one in cameras if one.image_name in {c.image_name for c in test}] == [
        one.image_name for one in test
    ]
    assert len(train) + len(test) == len(cameras) and all(one.is_test for one in test)
    assert not any(one.is_test for one in train)
    return [one.image_name for one in test]


def test_a_sector_holds_all_cameras_between_two_angles_in_any_frame_of_the_world():
    degrees = [15.0 * i for i in range(24)]
    expected = [f"{level}_0{number}" for level in (0, 1) for number in range(3)]  # counter-clockwise from 1_00
    for frame in (None, *Rotation.random(5, random_state=0)):
        assert names(ring(degrees, frame), "sector") == expected
    clockwise = [-angle for angle in degrees]
    assert names(ring(clockwise), "sector") == ["0_00", "0_22", "0_23", "1_00", "1_22", "1_23"]


def test_a_sector_spans_no_gap_that_the_cameras_leave():
    arc = [-6.0 * ((i - 6) % 12) for i in range(12)]  # 0_06 in the middle would begin one with 294 empty degrees
    assert names(ring(arc)[:12], "sector") == ["0_06", "0_07"]


@pytest.mark.parametrize("sway", [0.0, 0.05])
def test_a_sector_spans_no_pause_of_a_video(sway):
    paused = np.repeat(9.0 * np.arange(40), [61 if place == 20 else 1 for place in range(40)])
    video = ring((paused + sway * np.random.default_rng(0).normal(size=100)).tolist())[:100]
    assert names(video, "sector") == ["0_81", "0_82", "0_83", "0_84", "0_85"]
    assert len(names(video[15:86], "sector")) <= 9  # begins at places behind the pause


def test_a_block_is_in_the_middle_of_the_names_and_every_8th_is_as_before():
    cameras = ring([15.0 * i for i in range(10)])
    order = [one.image_name for one in cameras]
    assert names(cameras, "block") == order[8:11] and names(cameras, "every8") == order[::8]
    assert names(cameras[:5], "block") == order[1:3]
    assert split(cameras, False, "block", Path("scene"))[1] == []


def test_scenes_without_a_sector_or_with_too_few_photos_are_refused():
    outward, few = ring([15.0 * i for i in range(24)], sign=1.0), ring([0.0])
    for cameras, rule, said in (
        (outward, "sector", "needs cameras that look at one place; take --holdout block"),
        (few, "block", "has too few photos for --holdout block, which holds out a block; leave --holdout block out"),
        (few[:1], "every8", "has too few photos for --eval, which holds out every 8th; leave --eval out"),
    ):
        with pytest.raises(UserError, match=said):
            split(cameras, True, rule, Path("scene"))


def test_a_scene_with_its_own_test_photos_refuses_it(colmap_scene, tmp_path):
    assert len(read(colmap_scene, True, rule="block").test_cameras) == 2
    with pytest.raises(UserError, match="--holdout block holds photos out only with --eval; give --eval, too"):
        read(colmap_scene, rule="block")
    (colmap_scene / "sparse" / "0" / "test.txt").write_text("left/V00.png\n")
    make_blender_scene(tmp_path / "blender")
    make_nerfstudio_scene(tmp_path / "studio")
    shutil.rmtree(tmp_path / "studio" / "sparse")
    file = tmp_path / "studio" / "transforms.json"
    assert len(read(tmp_path / "studio", True, rule="block").test_cameras) == 2
    first = json.loads(file.read_text())["frames"][0]["file_path"]
    edit_json(file, lambda content: content.update(test_filenames=[first]))
    for scene, listed in (
        (colmap_scene, "sparse/0/test.txt"),
        (tmp_path / "blender", "transforms_test.json"),
        (tmp_path / "studio", "transforms.json"),
    ):
        assert read(scene, True).test_cameras
        with pytest.raises(UserError, match=f"{scene / listed} lists the test photos of this scene; leave --holdout s"):
            read(scene, True, rule="sector")


def test_a_model_keeps_its_split_and_is_not_resumed_with_another(colmap_scene, tmp_path):
    out, words = tmp_path / "out", ("--eval", "-r", 24, "--iterations", 3, "--holdout")
    train_on(colmap_scene, out, *words, "block", "--checkpoint_iterations", 2)
    held = [view["img_name"] for view in json.loads((out / "cameras.json").read_text())[:2]]
    assert held == [view.image_name for view in read(colmap_scene, True, rule="block").test_cameras]
    assert json.loads((out / "model.json").read_text())["holdout"] == "block"
    assert _split_views(out, None, 2) == "--holdout block"
    said = "chkpnt2.pth was trained with --holdout block, so it has seen photos that --holdout sector holds out; give"
    with pytest.raises(UserError, match=said):
        train_on(colmap_scene, out, *words, "sector", "--start_checkpoint", out / "chkpnt2.pth")
    with pytest.raises(
        UserError, match="keeps iteration 3 of .* with --holdout block, and this one has --holdout every8"
    ):
        train_on(colmap_scene, out, "--eval", "-r", 24, "--iterations", 2)
