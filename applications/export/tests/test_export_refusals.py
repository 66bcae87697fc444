"""Calls of export.py that are refused: each gets one sentence and leaves nothing."""

import pytest
from html_scene import balls
from small_splats import written

from utils.system_utils import UserError


@pytest.mark.parametrize(("words", "said"), [
    ("-m MODEL --to a.ply --clean 0", "--clean must be above 0 dB, got 0.0"),
    ("--ply FILE --to b.ply --clean", "--max_splats, --clean, --walk and meshes need training views"),
    ("FILE -m FOLDER --to a.ply", "stands alone; beside -m or --ply, give one file by --ply"),
    ("-m MODEL --to a.ply --voxel 0.1", "--voxel is for mesh.ply or mesh.glb or mesh.obj or mesh.usdz; leave it out"),
    ("-m MODEL --to a.ply --triangles 900", "--triangles is for mesh.ply or mesh.glb or mesh.obj or mesh.usdz"),
    ("-m MODEL --to mesh.ply --triangles 0", "--triangles must be 100 or above, got 0"),
    ("-m MODEL --to mesh.ply --voxel 0", "--voxel must be above 0, got 0.0"),
    ("-m MODEL --to a.html --start nowhere", "--start nowhere is no training photo"),
    ("-m MODEL --to a.html --path spiral", "--path"),
    ("-m MODEL --to a.html --raw --clean", "contradict"),
    ("-m MODEL --to a.ply --title Room", r"--title is for \.html"),
    ("-m MODEL --to a.ply --upright --no_upright", "contradict"),
])  # fmt: skip
def test_one_sentence_and_no_file(early, tmp_path, monkeypatch, run_export, words, said):
    monkeypatch.chdir(tmp_path)
    file = written(tmp_path, ".splat", balls())
    given = {"MODEL": early, "FILE": file, "FOLDER": tmp_path}
    with pytest.raises(UserError, match=said) as error:
        run_export(*(given.get(word, word) for word in words.split()))
    assert "\n" not in str(error.value) and [*tmp_path.iterdir()] == [file]
