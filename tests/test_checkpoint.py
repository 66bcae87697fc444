"""chkpntN.pth: ours, the reference's, and what must not be loaded."""

import io
import os
import pickle
import zipfile

import numpy as np
import pytest
import torch
from gaussians import model, parameters, take_steps

from scene.checkpoint import load_checkpoint, save_checkpoint
from utils.system_utils import UserError


def _plain(value: object) -> bool:
    if isinstance(value, dict):
        return all(_plain(part) for part in (*value.keys(), *value.values()))
    if isinstance(value, list | tuple):
        return all(_plain(part) for part in value)
    return value is None or type(value) in (torch.Tensor, int, float, bool, str)


def test_round_trip_of_plain_values(tmp_path):
    gaussians = model(12)
    take_steps(gaussians, 1)
    capture = gaussians.capture()
    assert len(capture) == 12 and _plain(capture)
    save_checkpoint(tmp_path / "chkpnt7.pth", capture, 7)
    loaded, iteration = load_checkpoint(tmp_path / "chkpnt7.pth")
    assert iteration == 7 and len(loaded) == 12
    for old, new in zip(capture[1:10], loaded[1:10], strict=True):
        assert torch.equal(old, new)
    # Anyone's safe loader takes it too.
    torch.load(tmp_path / "chkpnt7.pth", weights_only=True)


def _as_numpy_1(path) -> None:
    """Rewrite the pickle inside so that it names NumPy's function as NumPy 1 did."""
    source = zipfile.ZipFile(path)
    parts = {name: source.read(name) for name in source.namelist()}
    source.close()
    with zipfile.ZipFile(path, "w") as target:
        for name, content in parts.items():
            if name.endswith("data.pkl"):
                assert b"numpy._core.multiarray" in content
                content = content.replace(b"cnumpy._core.multiarray\n", b"cnumpy.core.multiarray\n")
                assert b"numpy._core" not in content
            target.writestr(name, content)


@pytest.mark.parametrize("numpy", [1, 2])
@pytest.mark.parametrize("scalar", [np.float32, np.float64])
def test_the_references_checkpoint_loads(tmp_path, scalar, numpy):
    """Its form: parameters as nn.Parameter, the extent as a NumPy scalar, an optimiser state of torch's own Adam."""
    gaussians = model(6)
    take_steps(gaussians, 2)
    capture = list(gaussians.capture())
    for i in range(1, 7):
        capture[i] = torch.nn.Parameter(capture[i])
    capture[11] = scalar(2.5)
    torch.save((tuple(capture), 3000), tmp_path / "chkpnt3000.pth")
    if numpy == 1:
        _as_numpy_1(tmp_path / "chkpnt3000.pth")
    loaded, iteration = load_checkpoint(tmp_path / "chkpnt3000.pth")
    assert iteration == 3000
    from gaussians import options

    other = model(2)
    other.restore(loaded, options())
    assert other.spatial_lr_scale == 2.5 and type(other.spatial_lr_scale) is float
    for name, value in parameters(gaussians).items():
        assert torch.equal(parameters(other)[name], value)
    take_steps(other, 1)


class _Bomb:
    def __reduce__(self) -> tuple:
        return os.mkdir, ("boom",)


def _wrong_files(folder) -> dict[str, str]:
    """Path by kind -> the words that its message must have."""
    (folder / "folder").mkdir()
    (folder / "point_cloud.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\n")
    (folder / "text").write_text("hello")
    (folder / "empty").write_bytes(b"")
    capture = model(3).capture()
    save_checkpoint(folder / "whole", capture, 1)
    (folder / "cut").write_bytes((folder / "whole").read_bytes()[:1000])
    torch.save({"weights": torch.zeros(3)}, folder / "dictionary")
    torch.save((capture[:11], 5), folder / "eleven")
    torch.save(((*capture[:9], capture[9][:2], *capture[10:]), 5), folder / "lengths")
    torch.save(((*capture, torch.zeros(2, 1)), 5), folder / "further")
    torch.save((*capture, _Bomb()), folder / "bomb")
    buffer = io.BytesIO()
    pickle.dump(_Bomb(), buffer, protocol=2)
    (folder / "pickle").write_bytes(buffer.getvalue())
    with zipfile.ZipFile(folder / "zip", "w") as archive:
        archive.writestr("a.txt", "hello")
    return {
        "folder": "is a folder; give the file",
        "point_cloud.ply": "is a PLY",
        "absent": "no checkpoint",
        "text": "chkpntN.pth",
        "empty": "chkpntN.pth",
        "cut": "chkpntN.pth",
        "dictionary": "parts do not fit",
        "eleven": "parts do not fit",
        "lengths": "parts do not fit",
        "further": "parts do not fit",
        "bomb": "never run",
        "pickle": "never run",
        "zip": "chkpntN.pth",
    }


def test_wrong_files_end_in_a_sentence_and_run_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, words in _wrong_files(tmp_path).items():
        with pytest.raises(UserError) as caught:
            load_checkpoint(tmp_path / name)
        assert words in str(caught.value) and "\n" not in str(caught.value), name
    assert not (tmp_path / "boom").exists()


def test_a_failed_save_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "chkpnt1.pth"
    save_checkpoint(path, model(3).capture(), 1)
    before = path.read_bytes()

    def fail(_: object, target) -> None:
        target.write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr("scene.checkpoint.torch.save", fail)
    with pytest.raises(OSError, match="disk full"):
        save_checkpoint(path, model(3).capture(), 1)
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["chkpnt1.pth"]
