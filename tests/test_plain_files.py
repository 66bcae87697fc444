"""Our own JSON files, and refusals, in a sentence, of what is no file, or a text without end."""

import contextlib
import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from applications.evaluation.configs import read_configs
from arguments import read_cfg_args, read_model_json
from gaussian_renderer.camera_paths.keyframes import read_camera_path
from gaussian_renderer.camera_paths.render_path import path_maker
from groundwork.files.image_files import read_plane
from groundwork.files.json_files import read_json, write_json
from groundwork.files.plain_files import MOST
from scene.dataset_readers import read_scene
from scene.gaussians.checkpoint import load_checkpoint
from scene.gaussians.exposure import read_pretrained
from scene.images.decode import picture_size
from scene.readers.point_cloud import read_point_cloud
from splatting.features.time_budget_file import read_schedule
from splatting.records.error_curve import read_curve, read_peer
from splatting.records.training_log import read_log
from utils.lpips_utils import _load_state
from utils.system_utils import UserError

needs_pipes = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
TEXTS = {
    "cfg_args": lambda path: read_cfg_args(path.parent),
    "exposure.json": lambda path: read_pretrained(path.parent),
    "transforms.json": lambda path: read_scene(path.parent, "images", False),
    "a camera path": read_camera_path,
    "--path": lambda path: path_maker(str(path)),
    "option sets": lambda path: read_configs(path, None),
    "a schedule": read_schedule,
}
FILES = TEXTS | {
    "a peer's curve": read_peer,
    "a curve": read_curve,
    "a photo": picture_size,
    "a plane": read_plane,
    "LPIPS weights": _load_state,
    "a point cloud": read_point_cloud,
    "a checkpoint": load_checkpoint,
}


@contextlib.contextmanager
def _soon() -> Iterator[None]:
    """Fail what waits or reads for ever."""

    def late(*_: object) -> None:
        pytest.fail("it waits or reads without end")  # which is no Exception, so nobody takes it for a refusal

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(20)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def _endless(path: Path, kind: str) -> Path:
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.touch()
        os.truncate(path, MOST + 1)
    return path


@needs_pipes
@pytest.mark.parametrize("kind", ["pipe", "device"])
@pytest.mark.parametrize("what", FILES)
def test_what_is_no_file_is_refused_at_once(tmp_path, what, kind):
    with _soon(), pytest.raises(UserError) as refused:
        FILES[what](_endless(tmp_path / what, kind))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("what", TEXTS)
def test_a_text_of_any_size_is_not_read(tmp_path, what):
    with _soon(), pytest.raises(UserError) as refused:
        TEXTS[what](_endless(tmp_path / what, "large"))
    assert "more than 256 MiB" in str(refused.value) or what == "cfg_args"


@needs_pipes
def test_records_of_a_model_are_no_pipes(tmp_path):
    """A model folder without them is one of another program."""
    for name in ("model.json", "train_log.json"):
        _endless(tmp_path / name, "pipe")
    with _soon():
        assert read_model_json(tmp_path) == {} and read_log(tmp_path / "train_log.json") == []


def test_names_of_any_kind_come_back_and_stay_readable(tmp_path):
    path = tmp_path / "new" / "a.json"
    content = {"photos": ["Straße.jpg", "写真.jpg", os.fsdecode(b"\xff.jpg"), "\U0001f30d"], "a": 1}
    write_json(path, content)
    assert read_json(path) == content == json.loads(path.read_bytes())
    text = path.read_text(encoding="utf-8")
    assert "Straße.jpg" in text and "写真.jpg" in text and text.endswith("}\n")
    assert text.index('"a"') < text.index('"photos"')
    write_json(path, content, sort_keys=False)
    assert list(read_json(path)) == ["photos", "a"]


def test_no_nan_and_the_old_file_stays(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, [1])
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(path, [float("nan")])
    assert read_json(path) == [1] and os.listdir(tmp_path) == ["a.json"]
