"""Checkpoints that are resumed with more photos than they were trained on."""

import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from synthetic import make_colmap_scene
from trainings import before_steps, train_on

from scene.gaussians.checkpoint import load_checkpoint, save_checkpoint, with_extra_state
from splatting.iteration import ViewOrder
from splatting.resume_photos import NewFirst, _find_end, restore_order
from utils.system_utils import UserError

WORDS = ("-r", 24, "--no_curve", "--disable_viewer", "--test_iterations", -1, "--densify_until_iter", 0)
FIRST = 40


@pytest.fixture(autouse=True)
def own_streams(monkeypatch):
    monkeypatch.setattr(sys, "stdout", sys.stdout)  # training stamps it


def _without(scene: Path, folder: Path, names: list[str], shift: float = 0.0) -> Path:
    """The scene without some photos, its model moved by `shift`."""
    import pycolmap

    shutil.copytree(scene, folder)
    model = pycolmap.Reconstruction(str(folder / "sparse/0"))
    for image in list(model.images.values()):
        if image.name in names:
            model.deregister_frame(image.frame_id)
            (folder / "images" / image.name).unlink()
    if shift:
        model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), [shift, 0, 0]))
    model.write_binary(str(folder / "sparse/0"))
    return folder


def _names(scene: Path) -> list[str]:
    images = scene / "images"
    return sorted(path.relative_to(images).as_posix() for path in images.rglob("*.png"))


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> tuple[Path, Path, list[str]]:
    """A scene, the same without two photos, and their names."""
    folder = tmp_path_factory.mktemp("grown")
    make_colmap_scene(folder / "whole")
    new = _names(folder / "whole")[-2:]
    return folder / "whole", _without(folder / "whole", folder / "part", new), new


@pytest.fixture(scope="module")
def first(scenes, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("first")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdout", sys.stdout)
        train_on(scenes[1], out, *WORDS, "--iterations", FIRST)
    return out / f"chkpnt{FIRST}.pth"


def test_new_photos_train_more_often_at_first(scenes, first, tmp_path, monkeypatch, capfd):
    whole, _, new = scenes
    names = []
    before_steps(monkeypatch, lambda step: names.append(step.camera.image_name))
    train_on(whole, tmp_path / "out", *WORDS, "--start_checkpoint", first, "--iterations", 80)
    # Trained 40 / 15 times each: the two new ones catch up within 10 iterations.
    said = capfd.readouterr()
    assert "2 photos are new; until iteration 50 every second one trains on one of them" in said.out
    assert f"was trained with --source_path {scenes[1]}, this run has --source_path {whole}" in said.err
    assert names[:10:2] == [name for name in names[:10] if name in new] and {*names[:4:2]} == {*new}
    assert len({*names[10:27]}) > 13 and len(names) == 40
    assert not {*names[1:10:2]} & {*new}


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--refine_poses",), "corrects 17 of 17 poses"),
        (("--robust_mask", 0.3, "--sparse_depth", 0.5), "2 photos are new"),
        (("--train_test_exp",), "of other photos than this run's, which cannot be added; give the scene"),
        (("--appearance", "ppisp"), "of other photos than this run's, which cannot be added; give the scene"),
    ],
)
def test_options_that_keep_something_of_each_photo(scenes, tmp_path, more, said, capfd):
    """And what may be added trains to the same bytes after a stop, also from a checkpoint of 0.3."""
    train_on(scenes[1], tmp_path / "a", *WORDS, "--iterations", 20, *more)
    words = *WORDS, "--iterations", 50, *more, "--checkpoint_iterations", 30, "--start_checkpoint"
    if "cannot" in said or "leave" in said:
        with pytest.raises(UserError, match=said):
            train_on(scenes[0], tmp_path / "b", *words, tmp_path / "a/chkpnt20.pth")
        return
    whole = train_on(scenes[0], tmp_path / "b", *words, tmp_path / "a/chkpnt20.pth")
    assert said in capfd.readouterr().out
    assert train_on(scenes[0], tmp_path / "c", *words, tmp_path / "b/chkpnt30.pth") == whole
    capture, iteration = load_checkpoint(tmp_path / "b/chkpnt30.pth")
    old = {"since": 20, "until": 25, "names": scenes[2]}
    assert capture[10].pop("resume") == old
    save_checkpoint(tmp_path / "b/chkpnt30.pth", with_extra_state(capture, {"more_photos": old}), iteration)
    assert train_on(scenes[0], tmp_path / "d", *words, tmp_path / "b/chkpnt30.pth") == whole


def test_what_cannot_be_continued_is_refused(scenes, first, tmp_path):
    whole, part, _ = scenes
    held = _without(whole, tmp_path / "held", _names(whole)[:1])
    train_on(held, tmp_path / "first", *WORDS, "--eval", "--iterations", 20)
    moved, other = _without(whole, tmp_path / "moved", [], shift=0.5), _without(part, tmp_path / "other", [])
    start, out = ("--start_checkpoint", first, "--iterations", 80), tmp_path / "out"
    # Into the checkpoint's own folder, in which --resume by itself would start over.
    cases = {
        r"was not trained on; give --start_checkpoint \S*chkpnt40.pth and name another": (whole, first.parent, start),
        "have other poses than when .* was trained .*with all others fixed": (moved, out, start),
        "is of another scene": (other, out, start),
        "--eval would hold out photos that .* was trained on":
            (whole, out, ("--eval", "--iterations", 40, "--start_checkpoint", tmp_path / "first/chkpnt20.pth")),
        "with more photos, --holdout block would hold out some that .* was trained on; start a new training":
            (whole, out, ("--eval", "--holdout", "block", "--start_checkpoint", tmp_path / "first/chkpnt20.pth")),
    }  # fmt: skip
    for said, (scene, folder, words) in cases.items():
        with pytest.raises(UserError, match=said):
            train_on(scene, folder, *WORDS, *words)


def test_the_order_takes_all_views():
    views = [SimpleNamespace(image_name=str(number)) for number in range(7)]
    every = ViewOrder(views, 0)
    order = NewFirst(every, 100, 180, ["5", "6"])
    names = [order[t].image_name for t in range(101, 181)]
    assert {names[t] for t in range(0, 80, 2)} == {"5", "6"} and {*names[1::2]} == {*"01234"}
    assert all(order[t] is every[t] for t in (99, 100, 181, 500))
    assert [NewFirst(every, 1, 9, ["x"])[t] for t in range(1, 20)] == [every[t] for t in range(1, 20)]
    for names, last, until in ((["5", "6"], 1000, 180), (["5"], 120, 110), (["5"], None, 133)):
        run = SimpleNamespace(first_iteration=100, schedule=SimpleNamespace(ends=last), views=every)
        assert _find_end(run, names) == until


@pytest.mark.parametrize(
    "state", [None, {}, {"since": 1.5, "until": 3, "names": []}, {"since": 1, "until": 3, "names": 4}]
)
def test_damaged_records(state):
    with pytest.raises(UserError, match="record of added photos is damaged"):
        restore_order(ViewOrder([SimpleNamespace(image_name="a")], 0), state)
