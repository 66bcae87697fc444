"""Checkpoints chkpntN.pth: ours, the reference's, and files that must not be loaded."""

import copy
import io
import os
import pickle
import zipfile
from collections.abc import Callable

import numpy as np
import pytest
import torch
from gaussians import FURTHER, model, options, parameters, take_steps

from scene.gaussian_model import GaussianModel
from scene.gaussians.checkpoint import load_checkpoint, save_checkpoint
from utils.system_utils import UserError

try:
    import resource
except ImportError:
    resource = None


def _plain(value: object) -> bool:
    if isinstance(value, dict):
        return all(_plain(part) for part in (*value.keys(), *value.values()))
    if isinstance(value, list | tuple):
        return all(_plain(part) for part in value)
    return value is None or type(value) in (torch.Tensor, torch.nn.Parameter, int, float, bool, str)


def test_round_trip_of_plain_values(tmp_path):
    gaussians = model(12)
    take_steps(gaussians, 1)
    capture = gaussians.capture()
    assert len(capture) == 12 + len(FURTHER) and _plain(capture)
    save_checkpoint(tmp_path / "chkpnt7.pth", capture, 7)
    loaded, iteration = load_checkpoint(tmp_path / "chkpnt7.pth")
    assert iteration == 7 and len(loaded) == len(capture)
    for old, new in zip(capture[1:10], loaded[1:10], strict=True):
        assert torch.equal(old, new)
    # torch's safe loader accepts it too.
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
    """The reference's form: nn.Parameter, the extent as a NumPy scalar, an optimiser state of torch's Adam."""
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
    other = model(2)
    other.restore(loaded, options())
    assert other.spatial_lr_scale == 2.5 and type(other.spatial_lr_scale) is float
    for name, value in parameters(gaussians).items():
        assert torch.equal(parameters(other)[name], value)
    take_steps(other, 1)


def test_plain_tensors_and_other_optimisers_are_captured_and_restored():
    gaussians = model(12)
    gaussians._opacity = gaussians._opacity.detach() * 0.5
    gaussians.optimizer = torch.optim.Adam(gaussians.optimizer.param_groups, lr=0.0, eps=1e-15)
    gaussians._xyz.grad = torch.ones(12, 3)
    gaussians.optimizer.step()
    capture = gaussians.capture()
    assert all(isinstance(t, torch.nn.Parameter) and t.requires_grad for t in capture[1:7])

    class Client(GaussianModel):
        def training_setup(self, training_args):
            super().training_setup(training_args)
            self.optimizer = torch.optim.Adam(self.optimizer.param_groups, lr=0.0, eps=1e-15)

    for kind in (GaussianModel, Client):
        other = kind(3)
        other.restore(capture, options())
        assert torch.equal(other._opacity, gaussians._opacity)
        assert torch.equal(
            other.optimizer.state[other._xyz]["exp_avg"], gaussians.optimizer.state[gaussians._xyz]["exp_avg"]
        )


class _Bomb:
    def __reduce__(self) -> tuple:
        return os.mkdir, ("boom",)


def _wrong_files(folder) -> dict[str, str]:
    """Faulty checkpoints by kind, with the words that their message must contain."""
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
        "absent": "absent; give one of chkpnt5.pth",
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
    (tmp_path / "chkpnt5.pth").touch()
    for name, words in _wrong_files(tmp_path).items():
        with pytest.raises(UserError) as caught:
            load_checkpoint(tmp_path / name)
        assert words in str(caught.value) and "\n" not in str(caught.value), name
    assert not (tmp_path / "boom").exists()


def _changed(capture: tuple, index: int, value: object) -> tuple:
    return (*capture[:index], value, *capture[index + 1 :])


def _with_state(capture: tuple, change: Callable[[dict], object]) -> tuple:
    state = copy.deepcopy(capture[10])
    change(state)
    return _changed(capture, 10, state)


def test_parts_that_do_not_fit_end_in_a_sentence(tmp_path):
    gaussians = model(4)
    take_steps(gaussians, 1)
    good = gaussians.capture()
    nan = good[1].clone()
    nan[2, 1] = float("nan")
    empty = tuple(t[:0] if torch.is_tensor(t) else t for t in good)
    cases = {
        "not a pair": torch.zeros(2),
        "entries": ([1, 2], 3),
        "the iteration is -5": (good, -5),
        "the iteration is a str": (good, "x"),
        "the iteration is 2.5": (good, 2.5),
        "SH degree is 4": (_changed(good, 0, 4), 1),
        "SH degree is -3": (_changed(good, 0, -3), 1),
        "SH degree is a str": (_changed(good, 0, "x"), 1),
        "extent of the scene is a str": (_changed(good, 11, "x"), 1),
        "extent of the scene is nan": (_changed(good, 11, float("nan")), 1),
        "no Gaussians": (empty, 1),
        "float32": (_changed(good, 1, good[1].double()), 1),
        "statistics": (_changed(good, 8, torch.zeros(4, 2)), 1),
        "xyz of the checkpoint": (_changed(good, 1, good[1][:, :2]), 1),
        "f_rest of the checkpoint": (_changed(good, 3, good[3].reshape(4, -1)), 1),
        "opacity of the checkpoint": (_changed(good, 6, good[6][:, 0]), 1),
        r"xyz of 1 of 4 Gaussians in the checkpoint .*Gaussian 2\)": (_changed(good, 1, nan), 1),
        "is not the state of an optimiser": (_changed(good, 10, 5), 1),
        "not the state of an optimiser": (_with_state(good, lambda s: s["param_groups"][0].update(params=[{}])), 1),
        "exp_avg or exp_avg_sq of xyz is missing": (_with_state(good, lambda s: s["state"][0].pop("exp_avg")), 1),
        "exp_avg and f_dc differ": (_with_state(good, lambda s: s["state"][1].update(exp_avg=torch.zeros(3))), 1),
        "step of xyz": (_with_state(good, lambda s: s["state"][0].update(step="x")), 1),
        "step of xyz is nan": (_with_state(good, lambda s: s["state"][0].update(step=torch.tensor(torch.nan))), 1),
        "groups are different": (_with_state(good, lambda s: s["param_groups"].pop()), 1),
    }
    for words, content in cases.items():
        torch.save(content, tmp_path / "wrong.pth")
        with pytest.raises(UserError, match=words) as caught:
            model(2).restore(load_checkpoint(tmp_path / "wrong.pth")[0], options())
        assert "\n" not in str(caught.value), words
    torch.save((good, 1), tmp_path / "good.pth")
    model(2).restore(load_checkpoint(tmp_path / "good.pth")[0], options())
    with pytest.raises(UserError, match="active SH degree"):
        model(2, degree=0).restore(_changed(model(4, degree=0).capture(), 0, 3), options())


def test_one_flipped_bit_anywhere_is_noticed(tmp_path):
    """torch compares no checksums: weights that are off by 1e9 would be trained on."""
    gaussians = model(50)
    take_steps(gaussians, 1)
    path = tmp_path / "chkpnt1.pth"
    save_checkpoint(path, gaussians.capture(), 1)
    whole = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        parts = [part for part in archive.infolist() if "data/" in part.filename and part.file_size]
    for part in parts:
        lengths = whole[part.header_offset + 26 : part.header_offset + 30]  # of name and padding, each in two bytes
        place = part.header_offset + 30 + lengths[0] + lengths[2] + 256 * lengths[3] + part.file_size // 2
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 16]) + whole[place + 1 :])
        with pytest.raises(UserError, match="chkpnt1.pth is damaged: a part of it does not have the checksum"):
            load_checkpoint(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("chkpnt1/data.pkl", bytes(1 << 20))
    with pytest.raises(UserError, match="is not a checkpoint of train.py"):
        load_checkpoint(path)


@pytest.mark.parametrize(
    "unreal",
    [
        lambda values: values[:1].expand(len(values) << 20, *values.shape[1:]),
        lambda values: values.to_sparse(),
        lambda values: values.to("meta"),
    ],
    ids=["expanded", "sparse", "meta"],
)
@pytest.mark.parametrize("place", [1, 8, "exp_avg"])
def test_tensors_that_are_not_in_the_file_are_refused(tmp_path, unreal, place):
    gaussians = model(5)
    take_steps(gaussians, 1)
    content = gaussians.capture()
    if place == "exp_avg":
        content = _with_state(content, lambda s: s["state"][0].update(exp_avg=unreal(s["state"][0]["exp_avg"])))
    else:
        content = _changed(content, place, unreal(content[place]))
    torch.save((content, 7), tmp_path / "chkpnt7.pth")
    with pytest.raises(UserError, match="objects other than whole tensors, numbers and text"):
        load_checkpoint(tmp_path / "chkpnt7.pth")


def test_a_checkpoint_without_averages_of_adam_is_told_of(capsys):
    gaussians = model(5)
    take_steps(gaussians, 1)
    good = gaussians.capture()
    model(2).restore(good, options())
    assert capsys.readouterr().err == ""
    keyed_by_text = _with_state(good, lambda s: s.update(state={str(key): part for key, part in s["state"].items()}))
    for content in (_with_state(good, lambda s: s.update(state={})), keyed_by_text):
        model(2).restore(content, options())
        assert "warning: the checkpoint has no averages of Adam for xyz, f_dc" in capsys.readouterr().err


@pytest.mark.skipif(resource is None, reason="this system has no limits of file sizes")
def test_a_full_disk_ends_in_a_sentence(tmp_path):
    """With the system's own reason, which torch hides."""
    capture = model(2000).capture()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, before[1]))
    try:
        with pytest.raises(UserError, match=r"cannot write .*chkpnt1.pth \(File too large\)"):
            save_checkpoint(tmp_path / "chkpnt1.pth", capture, 1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []
