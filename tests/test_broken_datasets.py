"""Every fault of broken_datasets.py gets a message of one sentence that a user can act on."""

import re
from pathlib import Path

import pytest
from broken_datasets import FAULTS, Fault, make_masters, message

# The pattern that the message for each fault must match: the file or value, and what is wrong with it.
SAID = {
    "no -s given": "no scene folder given",
    "the folder given with -s does not exist": "no scene folder SCENE/garden",
    "-s names a file": r"SCENE/sparse/0/cameras\.bin is a file; give -s .*, SCENE$",
    "the folder is empty": "SCENE is not a scene: .*found nothing",
    "photos only, nothing was reconstructed": "not a scene: .*found images;.* run python convert.py -s SCENE first$",
    "-s names the folder of the photos": "images is not a scene: .*found Right, left; give -s SCENE, which is a scene$",
    "-s names the folder of the model": "0 is not a scene: .*found cameras.bin.*; give -s SCENE, which is a scene$",
    "-s names the folder around the scene": "not a scene: .*found garden; give -s a scene in it: SCENE/garden$",
    "the output folder lies in the scene": "the output folder SCENE/output lies in the scene folder",
    "sparse/0 is empty": "no COLMAP model in SCENE/sparse/0.*found sparse/0;",
    "images.bin is missing": "no COLMAP model in SCENE/sparse/0(?!.*sparse/0/images.bin).*sparse/0/cameras.bin",
    "points3D.bin is missing": "no COLMAP model in SCENE/sparse/0(?!.*points3D.bin).*sparse/0/cameras.bin",
    "cameras.bin is cut short": "SCENE/sparse/0/cameras.bin ends within camera 1 of 1",
    "images.bin is cut short": r"SCENE/sparse/0/images\.bin ends within photo 9 of 9",
    "points3D.bin is cut short": r"SCENE/sparse/0/points3D\.bin ends within point 292 of 300",
    "cameras.bin is empty": r"^SCENE/sparse/0/cameras\.bin is empty; copy the file again from where it was made$",
    "images.bin is an error page that was downloaded": r"SCENE/sparse/0/images\.bin is a web page",
    "the model registers no photo": "COLMAP model in SCENE/sparse/0 has no registered photo",
    "a word where cameras.txt needs a number": r"line 4 of SCENE/sparse/0/cameras\.txt .*wide",
    "a camera model that COLMAP does not have": r"line 4 of .*0/cameras\.txt .*no camera model PINHOLE2",
    "a spherical camera": "Right/V03.png has the camera model EQUIRECTANGULAR",
    "a focal length of zero": "camera of Right/V03.png has no usable size or focal length",
    "a principal point that is not a number": "camera of Right/V03.png has no usable size or focal length, .*nan",
    "a pose that is not finite": "pose of .*png is not finite",
    "a photo of a camera that is not in cameras.txt": r"SCENE/sparse/0/images\.txt has the camera 77",
    "a point that is not finite": r"line 4 of SCENE/sparse/0/points3D\.txt .*nan",
    "the folder images is missing": r"there is no folder SCENE/images,.*-i",
    "-i names a folder that is not there": r"there is no folder SCENE/images_4,.*-i$",
    "one photo is missing": "1 of 9 photos .*are missing: SCENE/images/left/v02.png",
    "the photos were converted to another format": r"9 of 9 photos .*Right/V03.png.*\(Right/V03.jpg is there instead\)",
    "a photo is a link to nothing": r"1 of 9 photos .* missing: SCENE/images/left/v02.png \(it is there, but",
    "a photo is cut short": "cannot read SCENE/images/left/v02.png .*truncated",
    "a photo is empty": r"SCENE/images/left/v02\.png is empty",
    "a photo is a Git LFS pointer": r"SCENE/images/left/v02\.png .*git lfs pull",
    "a photo has floating-point pixels": "cannot read SCENE/images/left/v02.png .*floating-point",
    "--eval with one photo": "SCENE has too few photos for --eval",
    "--init_pcd_path names no file": "no point cloud SCENE/dense.ply",
    "points3D.ply has no colours": "points3D.ply has no red, green, blue",
    "points3D.ply is cut short": "points3D.ply is not a readable PLY file",
    "points3D.ply has floating-point colours up to 255": "colours in SCENE/sparse/0/points3D.ply are neither",
    "transforms_test.json is missing": "no transforms_test.json in SCENE",
    "transforms_train.json is cut short": "SCENE/transforms_train.json is not a camera file .JSONDecodeError",
    "transforms_train.json has no camera_angle_x": "SCENE/transforms_train.json has neither camera_angle_x",
    "camera_angle_x is in degrees": "camera_angle_x in SCENE/transforms_train.json .*got 40.0.*radians",
    "no frames are listed": "SCENE/transforms_train.json lists no frames",
    "a transform_matrix has three rows": r"^frame 2 \(./train/r_1\) of SCENE/.* must be 4x4 .*got shape",
    "a transform_matrix can't be inverted": r"^frame 2 \(./train/r_1\) of SCENE/transforms_train.json .*[Ss]ingular",
    "a transform_matrix is mirrored": "pose of r_1 is mirrored",
    "a transform_matrix is sheared": "pose of r_1 has no rotation",
    "a frame has no file_path": r"^frame 2 of SCENE/transforms_train\.json has no file_path",
    "the photo of a frame is missing": "1 of 4 photos .*are missing: SCENE/train/r_1.png",
}


@pytest.fixture(scope="module")
def masters(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return make_masters(tmp_path_factory.mktemp("masters"))


def test_there_are_forty_different_ones():
    assert len({fault.what for fault in FAULTS}) == len(FAULTS) >= 40
    assert {fault.what for fault in FAULTS} == SAID.keys()


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.what)
def test_one_sentence_that_names_the_thing_and_the_remedy(fault, masters, tmp_path):
    text = message(fault, masters, tmp_path)
    assert "\n" not in text and "Traceback" not in text
    assert re.search(SAID[fault.what], text), text
    # The remedy follows the semicolon.
    what, semicolon, remedy = text.rpartition("; ")
    assert semicolon and len(what) > 15 and len(remedy.split()) >= 3, text


def test_a_sound_scene_is_taken(masters, tmp_path):
    for kind in masters:
        (tmp_path / kind).mkdir()
        with pytest.raises(AssertionError, match="is taken"):
            message(Fault("none", kind, lambda scene: None), masters, tmp_path / kind)
