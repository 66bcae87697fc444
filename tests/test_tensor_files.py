"""Files of torch.save without torch's unpickler: the tensors that torch reads, in both formats, and nothing else."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from fuzz import crafted_pickles as crafted

from groundwork.files.tensor_files import read_tensors

_DTYPES = [torch.float32, torch.float64, torch.float16, torch.bfloat16, torch.int64, torch.int32, torch.int16]
_DTYPES += [torch.int8, torch.uint8, torch.bool]


def _content() -> dict:
    """Whatever a checkpoint or a state dict holds."""
    base = torch.arange(24.0).reshape(4, 6)
    layer = torch.nn.Linear(3, 2)
    optimizer = torch.optim.Adam(layer.parameters())
    layer(torch.ones(3)).sum().backward()
    optimizer.step()
    return {
        "dtypes": [torch.arange(5).to(dtype) for dtype in _DTYPES],
        "views": (base, base.T, base[1:, 2:4], base[:, None], base[2, 3], base[4:], base.view(-1)[::5]),
        "empty": [torch.zeros(0), torch.zeros(0, 3), torch.zeros(7, 0, 3)],
        "gradients": (torch.ones(2, requires_grad=True), torch.nn.Parameter(base), torch.nn.Parameter(base[1], False)),
        "same": [base] * 3,
        "layer": layer.state_dict(),
        "optimizer": optimizer.state_dict(),
        "plain": [None, True, 0, -1, 255, 2**31, -(2**62), 10**30, 0.5, float("inf"), "x", "ä" * 300, (), [], {}, (1,)],
    }


def _assert_same(found: object, wanted: object) -> None:
    if isinstance(wanted, dict):
        assert type(found) is dict and list(found) == list(wanted)
        for key, value in wanted.items():
            _assert_same(found[key], value)
    elif isinstance(wanted, list | tuple):
        assert type(found) is type(wanted) and len(found) == len(wanted)
        for pair in zip(found, wanted, strict=True):
            _assert_same(*pair)
    elif torch.is_tensor(wanted):
        assert type(found) is type(wanted) and found.dtype == wanted.dtype and torch.equal(found, wanted)
        for of in (torch.Tensor.stride, torch.Tensor.storage_offset, lambda tensor: tensor.requires_grad):
            assert of(found) == of(wanted)
    else:
        assert type(found) is type(wanted) and found == wanted


@pytest.mark.parametrize("reading", [{}, {"mapped": True}, {"legacy": True}], ids=["copied", "mapped", "legacy"])
def test_tensors_are_those_that_torch_reads(tmp_path, reading):
    file = tmp_path / "file.pth"
    torch.save(_content(), file, _use_new_zipfile_serialization="legacy" not in reading)
    found = read_tensors(file, **reading)
    _assert_same(found, torch.load(file, weights_only=True))
    shared = [*found["views"], *found["same"], *found["gradients"][1:]]
    assert len({tensor.untyped_storage().data_ptr() for tensor in shared}) == 1
    if sys.platform == "linux":
        assert (str(file) in Path("/proc/self/maps").read_text()) == ("mapped" in reading)


@pytest.mark.parametrize("scalar", [np.float32(1.1), np.float64(1.1)])
def test_floats_of_numpy_become_pythons(tmp_path, scalar):
    torch.save([scalar, scalar], tmp_path / "file.pth")
    found = read_tensors(tmp_path / "file.pth")
    assert found == [float(scalar)] * 2 and {type(value) for value in found} == {float}


def test_files_of_the_first_torch_and_of_python_2(tmp_path):
    """torchvision's oldest weights are such files, and so are those within the package lpips."""
    of = crafted
    strided = [of.tuple_of(of.number(2))] * 2
    tensor = of.call(of.name("torch._utils", "_rebuild_tensor"), of.storage(), of.number(1), *strided)
    parameter = of.name("torch.nn.parameter", "Parameter") + of.tuple_of(tensor) + of.NEWOBJ
    parameter += of.tuple_of(of.FALSE, of.FALSE, of.NONE) + of.BUILD
    pair = of.LIST + of.MARK + b"U\x01a" + parameter + of.APPENDS
    (tmp_path / "file.pth").write_bytes(of.old_format(of.call(of.ORDERED, of.LIST + pair + of.APPEND)))
    found = read_tensors(tmp_path / "file.pth", legacy=True)
    _assert_same(found, {"a": torch.nn.Parameter(torch.zeros(8)[1:5:2], False)})

    (package,) = importlib.util.find_spec("lpips").submodule_search_locations
    for file in Path(package).rglob("*.pth"):
        _assert_same(read_tensors(file, legacy=True), torch.load(file, weights_only=True, map_location="cpu"))


def test_the_old_format_is_read_only_where_it_is_asked_for(tmp_path):
    torch.save([1], tmp_path / "file.pth", _use_new_zipfile_serialization=False)
    with pytest.raises(ValueError, match="it is damaged, or holds objects other than"):
        read_tensors(tmp_path / "file.pth")
    with pytest.raises(OSError):
        read_tensors(tmp_path)
