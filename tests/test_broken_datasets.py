"""Every fault of broken_datasets.py is answered in one sentence that a user can act on."""

import re
from pathlib import Path

import pytest
from broken_datasets import FAULTS, Fault, make_masters, message


@pytest.fixture(scope="module")
def masters(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return make_masters(tmp_path_factory.mktemp("masters"))


def test_there_are_forty_different_ones():
    assert len({fault.what for fault in FAULTS}) == len(FAULTS) >= 40


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.what)
def test_one_sentence_that_names_the_thing_and_the_remedy(fault, masters, tmp_path):
    text = message(fault, masters, tmp_path)
    assert "\n" not in text and "Traceback" not in text
    # The file, folder or option at fault, and after the semicolon what to do.
    assert re.search(r"SCENE|OUT| -[a-z]|left/v02.png|Right/V03.png", text), text
    what, semicolon, remedy = text.rpartition("; ")
    assert semicolon and len(what) > 15 and len(remedy.split()) >= 3, text


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("-s names a file", r"SCENE/sparse/0/cameras.bin is a file; give -s .*, SCENE$"),
        ("photos only, nothing was reconstructed", r"run python convert.py -s SCENE first$"),
        ("-s names the folder of the pictures", r"; give -s SCENE, which is one$"),
        ("-s names the folder of the model", r"; give -s SCENE, which is one$"),
        ("-s names the folder around the scene", r"; give -s a scene in it: SCENE/garden$"),
        (
            "images.bin is cut short",
            r"images.bin 64,577 bytes, .* does not fit together\); .*copy all three files again",
        ),
        (
            "points3D.bin is cut short",
            r"cameras.bin 64 bytes, images.bin .*, points3D.bin 35,908 bytes: what they hold",
        ),
        ("cameras.bin is empty", r"\(cameras.bin is empty\); .*copy all three files again from where they were made"),
        ("images.bin is an error page that was downloaded", r"\(images.bin is a web page"),
        ("a word where cameras.txt needs a number", r"line 4 of cameras.txt .*\(1 PINHOLE 96 64 wide 110 45 34.5\)"),
        ("a camera model that COLMAP does not have", r"line 4 of cameras.txt has the camera model PINHOLE2"),
        ("a principal point that is not a number", r"line 4 of cameras.txt .* 110 nan 34.5"),
        ("a pose that is not finite", r"line 5 of images.txt is no id, rotation, translation"),
        (
            "a picture of a camera that is not in cameras.txt",
            r"line 5 of images.txt has the camera 77, which is not in",
        ),
        ("a point that is not finite", r"line 4 of points3D.txt is no id, position"),
        ("the folder images is missing", r"there is no folder SCENE/images,"),
        ("-i names a folder that is not there", r"there is no folder SCENE/images_4,.*-i$"),
        ("the pictures were converted to another format", r"\(Right/V03.jpg is there instead\)"),
        ("a picture is a pointer of Git LFS", r"git lfs pull"),
        ("a transform_matrix has three rows", r"^frame 2 \(./train/r_1\) of SCENE/transforms_train.json"),
        ("a transform_matrix can't be inverted", r"^frame 2 \(./train/r_1\) of SCENE/transforms_train.json"),
        ("a frame has no file_path", r"^frame 2 of SCENE/transforms_train.json has no file_path"),
    ],
)
def test_what_is_told_of_it(what, said, masters, tmp_path):
    (fault,) = (fault for fault in FAULTS if fault.what == what)
    assert re.search(said, message(fault, masters, tmp_path))


def test_a_sound_scene_is_taken(masters, tmp_path):
    for kind in masters:
        (tmp_path / kind).mkdir()
        with pytest.raises(AssertionError, match="is taken"):
            message(Fault("none", kind, lambda scene: None), masters, tmp_path / kind)
