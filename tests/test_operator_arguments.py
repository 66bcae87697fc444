"""Every operator: torch's own checks of its registration, and wrong arguments, which end in errors that name them."""

import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import simple_knn.ops  # noqa: F401  (its kernel for shapes alone)
import torch
from fuzz.operators import Call, sound_calls
from rasterizer_tools import CPU_AND_GPU
from torch import Tensor, library

ROOT = Path(__file__).parents[1]
# What a forward keeps, by the names in errors.
KEPT = ("splats", "tile_counts", "instances", "ranges", "splat_slots", "slots", "last", "layers", "background")
KEPT += ("transmittance",)
REPORT = """
import sys
sys.path[:0] = ["tests", "."]
import groundwork.host.openmp
from fuzz.operators import outcomes
for outcome in outcomes():
    print("|".join(outcome), flush=True)
"""
RASTERIZER = (
    "project",
    "bin",
    "blend",
    "rasterize",
    "rasterize_vjp",
    "rasterize_vjp of rows",
    "blend_rows",
    "describe",
)
RASTERIZER += ("blend_channels", "channel_moments", "camera_vjp", "sum_runs", "describe_vjp", "pinhole")
RASTERIZER += ("rasterize_vjp of moments",)
OTHER_KINDS = ("float16", "int64", "int32", "bool", "complex64", "sparse", "a number")
OTHER_RANKS, OTHER_COLUMNS = ("one more axis", "is a scalar"), ("no columns", "one column more")
# Tensors that may be None.
NEEDLESS = ("means2d", "grad_transmittance", "grad_inverse_depth", "stopped", "words", "of", "planes[1]", "planes[2]")
NEEDLESS += ("places",)
# Tensors that may be of float64 beside others of float32, or that the dtype is taken from.
DOUBLE = ("view", "projection", "center", "background", "grad_color", "grad_transmittance", "grad_inverse_depth")
DOUBLE += ("splats", "rows", "image", "points", "like", "of", "camera[0]", "camera[1]", "camera[2]")
DOUBLE += ("planes[0]", "planes[1]", "planes[2]", "pose", "intrinsics")


@cache
def _calls() -> dict[str, Call]:
    return sound_calls()


def _argument(name: str, words: str) -> str:
    """Name of the argument that was changed; of a list of tensors, with the place in it."""
    place, bracket, inner = words.split()[1].partition("[")
    argument = _calls()[name][0].default._schema.arguments[int(place)].name
    return (
        KEPT[int(inner[:-1])] if argument == "source" and name.partition(" ")[2] == "" else argument + bracket + inner
    )


def test_every_changed_tensor_of_another_kind_is_an_error():
    """In another process, because a crash would end this one."""
    done = subprocess.run([sys.executable, "-c", REPORT], cwd=ROOT, capture_output=True, text=True)
    lines = [line.split("|") for line in done.stdout.splitlines()]
    assert done.returncode == 0, f"status {done.returncode} in the change after {lines[-1] if lines else 'none'}"
    registered = {name for name in torch._C._dispatch_get_all_op_names() if "::" in name}
    ours = {name for name in registered if name.startswith(("diff_gaussian", "fused_ssim", "simple_knn"))}
    assert {name.partition("::")[2] for name in ours} == {name.partition(" ")[0] for name, *_ in lines}
    assert len(lines) > 1500
    for name, words, outcome in lines:
        if words.endswith("shorter"):
            continue
        argument = _argument(name, words)
        no_columns = argument in ("slots", "instances", "layers")
        if words.endswith(OTHER_KINDS) or (words.endswith("float64") and argument not in DOUBLE):
            assert outcome.endswith("Error"), (name, words)
        elif words.endswith(" is None") and argument not in NEEDLESS:
            assert outcome.endswith("Error"), (name, words)
            if name in RASTERIZER and "[" not in words:  # of a list torch itself refuses it
                assert outcome in ("TypeError", "ValueError"), (name, words, outcome)
        elif name in RASTERIZER and words.endswith(OTHER_RANKS if no_columns else (*OTHER_RANKS, *OTHER_COLUMNS)):
            assert outcome in ("ValueError", "RuntimeError"), (name, words, outcome)


# Operators without a kernel for shapes alone: nobody compiles them.
UNCOMPILED = {"run_ahead_", "spilled", "spilled_bytes", "wake_", "photometric_band", "photometric_of_sums"}
UNCOMPILED |= {"exp", "log", "random_words"}
NOT_ON_GPU = {"step_now_", "penalise_"}
TRAINED = {  # inputs that have a gradient
    "rasterize": ("means2d", "means", "opacities", "scales", "rotations", "sh_dc", "sh_rest"),
    "l1_ssim": ("img1",),
    "photometric": ("image",),
}
UNGUARDED = {"loss": None, "stopped": None, "iteration": 0}
CHANGES = {"adam_ of visible rows": UNGUARDED}


def _named(call: Call, changes: dict[str, Any]) -> dict[str, Any]:
    """The arguments of a call by name. changes: others in their place, or functions of them."""
    operator, arguments = call
    names = [argument.name for argument in operator.default._schema.arguments]
    named = dict(zip(names, arguments, strict=False))
    return named | {name: new(named[name]) if callable(new) else new for name, new in changes.items()}


@CPU_AND_GPU
@pytest.mark.parametrize("name", sorted(sound_calls()))
def test_opcheck(name, device):
    if name in UNCOMPILED or (device == "cuda" and name in NOT_ON_GPU):
        pytest.skip("has no kernel for shapes alone, or its tensors lie on the CPU")
    call = sound_calls(device)[name]
    named = _named(call, CHANGES.get(name, {}))
    train = named.get("train", False) and name != "bin"
    for trained in TRAINED.get(name, ()) if train else ():
        named[trained].requires_grad_()
    checks = ["test_schema", "test_autograd_registration", "test_faketensor"]
    # On a GPU nobody writes all of what is kept for a backward, so that no two calls agree there.
    if name in TRAINED and not (device == "cuda" and train):
        checks.append("test_aot_dispatch_dynamic")
    library.opcheck(call[0].default, (), named, test_utils=checks)


def _integers(*numbers: int) -> Tensor:
    return torch.tensor(numbers, dtype=torch.int32)


def _changed(place: int, new: Any) -> Any:
    """A function that changes one tensor of a list."""
    return lambda tensors: [*tensors[:place], new(tensors[place]) if callable(new) else new, *tensors[place + 1 :]]


def _transposed(tensor: Tensor) -> Tensor:
    return tensor.T.contiguous().T


def _sums(counts: tuple, kept: tuple, room: int = 3, values: int = 10) -> dict:
    return {"rows": torch.rand(5, values), "counts": _integers(*counts), "kept": _integers(*kept), "room": room}


def _unseen(count: int) -> dict:
    counts = _integers(0, 2, 2), _integers(count, 4 - count, 2)
    return {"source": lambda t: [t[0], counts[0], t[2], counts[1]]}


OF_PARAMETER = "shape, dtype and device of the parameter"
OF_GRADIENT = r"the gradient must be \(3, 3\) float32 on cpu, or its lengths \(3,\), got "
OF_VISIBLE = r"visible must be \(3\) bool on cpu, got"
WRONG = {
    "adam_": [
        (RuntimeError, OF_PARAMETER, {"gradients": lambda t: [t[0], t[1].T]}),
        (RuntimeError, "must be contiguous", {"values": lambda t: [_transposed(t[0]), t[1]]}),
        (RuntimeError, "columns must be at most 3, got 4", {"columns": [4, -1]}),
        (RuntimeError, "for each of the 2 parameters, got 1", {"rates": [0.1]}),
        (RuntimeError, "step counter must be one float32 on the CPU", {"steps": lambda t: [t[0].int(), t[1]]}),
    ],
    "adam_ of visible rows": [
        (RuntimeError, "for each of the 1 parameters, got 2", {"steps": [torch.tensor(1.0), torch.tensor(1.0)]}),
        (RuntimeError, OF_VISIBLE, {"visible": torch.ones(4, dtype=torch.bool)}),
    ],
    "observe_": [
        (RuntimeError, "statistics must be 3 float32 on cpu, got .2", {"max_radii": torch.zeros(2)}),
        (RuntimeError, "statistics must be contiguous", {"max_radii": torch.zeros(6)[::2]}),
        (RuntimeError, rf"{OF_GRADIENT}\(2,\)", {"gradient": torch.ones(2)}),
    ],
    "list_records": [
        (ValueError, "tile_counts must be", {"tile_counts": lambda t: t[1:]}),
        (ValueError, r"limits must be \(2, -1", {"limits": lambda t: t[0]}),
        (RuntimeError, "a room of 2147483648 is not from 0 to 2", {"room": 2**31}),
    ],
    "list_records with counts": [
        (TypeError, "counts, splats and depths must be given together", {"depths": None}),
        (ValueError, r"counts must be \(3, 2\)", {"counts": lambda t: t[:, :1]}),
        (ValueError, r"depths must be \(3,\)", {"depths": lambda t: t[1:]}),
    ],
    "sum_runs": [
        (ValueError, r"rows must be \(R, 10\) or \(R, 12\), got \(5, 11\)", _sums((5,), (1,), values=11)),
        (ValueError, r"kept must be \(2,\)", _sums((3, 2), (1,))),
        (ValueError, "counts add up to 4, but there are 5 rows", _sums((3, 1), (1, 1))),
        (ValueError, "counts must be 0 or more, got -1 of run 1", _sums((6, -1), (1, 1))),
        (ValueError, "kept must be 0, 1 or the run's count, got 2 of run 0", _sums((3, 2), (2, 2))),
        (ValueError, "kept adds up to 4 rows, for which a room of 3 is too small", _sums((3, 2), (3, 1))),
        (RuntimeError, "a room of -1 is not from 0 to 2", _sums((3, 2), (1, 1), room=-1)),
        (ValueError, r"places must be \(2,\)", _sums((3, 2), (1, 1))),
        *(
            (
                ValueError,
                f"places must be 0 to 2 in any order, got {wrong} of run 2",
                {"places": _integers(1, 0, wrong)},
            )
            for wrong in (1, -1, 3)
        ),
    ],
    "rasterize_vjp of rows": [
        (ValueError, r"rows must be \(-1, 12\)", {"absolute": True}),
        (ValueError, r"rows must be \(-1, 10\)", {"source": _changed(2, lambda t: t[:, :9])}),
        (ValueError, r"counts must be \(3,\)", {"source": _changed(3, lambda t: t[1:])}),
        (
            ValueError,
            "counts add up to 7, but there are 6 rows",
            {"source": _changed(3, lambda t: t + _integers(0, 1, 0))},
        ),
        *((ValueError, f"got {count} of splat 0", _unseen(count)) for count in (1, -1)),
        (
            ValueError,
            "or splats, tile_counts, and rows and counts or moments, got 2 tensors",
            {"source": lambda t: t[:2]},
        ),
    ],
    "sum_blocks": [(ValueError, "sums must have columns", {"sums": lambda t: t[:, :0]})],
    "camera_vjp": [
        (
            ValueError,
            "takes splats, tile_counts, and rows and counts or moments, got 2 tensors",
            {"source": lambda t: t[:2]},
        ),
        (ValueError, r"rows must be \(-1, 12\)", {"absolute": True}),
        (ValueError, "there are 5 rows", {"source": _changed(2, lambda t: t[1:])}),
    ],
    "wake_": [
        (ValueError, "blocks of raw Gaussians sleep", {"options": lambda t: [*t[:4], False]}),
        (ValueError, "give awake, taken and terms", {"sleep": lambda t: t[:2]}),
        (ValueError, r"awake must be \(1,\)", {"sleep": _changed(0, lambda t: t.repeat(2))}),
        (ValueError, r"terms must be \(128, 8\)", {"sleep": _changed(2, lambda t: t[1:])}),
    ],
    "apply_gradients_": [
        (RuntimeError, "for each of the 6 attributes, got 5", {"rates": [0.1] * 5}),
        (RuntimeError, "two for each of the 6 attributes, got 11", {"averages": lambda t: t[1:]}),
        (RuntimeError, "different numbers from 0 to 5", {"attributes": [0, 1, 2, 3, 4, 4]}),
        (RuntimeError, "columns must be at most 45, got 46", {"columns": [-1] * 5 + [46]}),
        (ValueError, "constants must have 5 entries, got 3", {"constants": [0.9, 0.99, 1e-8]}),
        (RuntimeError, OF_PARAMETER, {"averages": lambda t: [*t[:5], t[0], *t[6:]]}),
        (RuntimeError, "must be contiguous", {"gaussians": _changed(0, _transposed)}),
        (RuntimeError, "must be contiguous", {"averages": _changed(0, _transposed)}),
        (RuntimeError, "step counter must be one float32 on the CPU", {"steps": _changed(5, torch.ones(2))}),
        (RuntimeError, "statistics must be 3 float32", {"statistics": _changed(2, torch.ones(2))}),
        (RuntimeError, "statistics must be contiguous", {"statistics": _changed(2, torch.ones(6)[::2])}),
        (RuntimeError, "max_radii, gradient_sums and views, or none", {"statistics": lambda t: t[:2]}),
        (ValueError, r"the camera's gradient must be \(34,\)", {"camera_gradient": torch.ones(25).double()}),
        (RuntimeError, "stopped must be one int64", {"guard": lambda t: [t[0], t[0]]}),
        (RuntimeError, "stopped must be one int64", {"guard": _changed(1, torch.zeros(1))}),
        (RuntimeError, "count from 1", {"iteration": 0}),
        (ValueError, "radii must be", {"radii": _integers(1, 1)}),
        (ValueError, "tile_counts must be", {"source": _changed(1, _integers(1, 1))}),
        (ValueError, "now must be contiguous", {"now": torch.zeros(46, dtype=torch.int64)[::2]}),
        (ValueError, "now must be", {"now": torch.zeros(21, dtype=torch.int64)}),
        (ValueError, "penalties are of raw", {"options": [7, 18, 3, 0, 0], "constants": [0.9, 0.99, 1e-8, 0, 0.1]}),
        (ValueError, "not cov3d or colors", {"gaussians": lambda t: [*t[:5], torch.rand(3, 3), t[5], t[5]]}),
        (ValueError, "give 8 tensors of the Gaussians and 3 or 4 of the camera", {"camera": lambda t: t[:2]}),
    ],
    "project": [
        (ValueError, "lens must have 3, 5, 25 or 27 entries, and options 5 or 6, got 2 and 5", {"lens": [0.5, 0.5]}),
        (
            ValueError,
            "lens must have 3, 5, 25 or 27 entries, and options 5 or 6, got 3 and 4",
            {"options": [7, 18, 3, 0]},
        ),
    ],
    "blend_channels": [
        (ValueError, "channels must have a column", {"channels": lambda t: t[:, :0], "background": lambda t: t[:0]}),
        *((ValueError, "cap must be between 0 and 1", {"cap": cap}) for cap in (0.0, 1.0, float("nan"))),
        (ValueError, r"background must be \(5,\)", {"background": torch.rand(3)}),
    ],
    "rasterize_vjp of moments": [(ValueError, "moments have no absolute gradients", {"absolute": True})],
    "channel_moments": [
        (ValueError, "cap must be between 0 and 1", {"cap": 1.0}),
        (ValueError, r"channels must be \(3, -1", {"channels": lambda t: t[1:]}),
        (ValueError, r"the gradient of an image must be \(5, 7, 18\)", {"grad_color": lambda t: t[:3]}),
    ],
    "displace_": [
        (ValueError, "give logits, or items", {"items": torch.arange(3)}),
        (ValueError, r"logits must be \(3, 1\).*got \(3,\)", {"logits": lambda t: t[:, 0]}),
        (ValueError, "means must be contiguous", {"means": _transposed}),
        (ValueError, "steepness from 0 to 10000, got 1 and 10001", {"gate": [1.0, 10001.0, 0.1]}),
        (ValueError, "a gate goes with logits", {"gate": []}),
    ],
    "displace_ to children": [
        (ValueError, r"rotations must be \(3, 4\).*got \(3, 3\)", {"rotations": lambda t: t[:, :3]}),
        (ValueError, r"items must be \(3,\).*got \(1, 3\)", {"items": lambda t: t[None]}),
    ],
    "penalise_": [
        (ValueError, r"log_scale_gradients must be \(3, 3\).*got \(3, 1\)", {"log_scale_gradients": torch.ones(3, 1)}),
        (ValueError, "gradients must be contiguous", {"log_scale_gradients": _transposed}),
    ],
}


def _tensors(named: dict[str, Any]) -> list[Tensor]:
    flat = [each for value in named.values() for each in (value if isinstance(value, list) else [value])]
    return [value.clone() for value in flat if torch.is_tensor(value)]


@pytest.mark.parametrize("name", WRONG)
def test_wrong_arguments_are_named_and_nothing_changes(name):
    call = sound_calls()[name]
    call[0](**_named(call, {}))
    for error, words, changes in WRONG[name]:
        named = _named(call, changes)
        before = _tensors(named)
        with pytest.raises(error, match=words):
            call[0](**named)
        assert all(torch.equal(*pair) for pair in zip(_tensors(named), before, strict=True)), words


def test_statistics_of_float64_are_refused():
    call = sound_calls(dtype=torch.float64)["apply_gradients_"]
    statistics = {"statistics": [torch.ones(3), torch.ones(3, 1), torch.ones(3, 1)]}
    with pytest.raises(RuntimeError, match="statistics are of float32 Gaussians"):
        call[0](**_named(call, statistics))


@pytest.mark.parametrize("name", ["adam_", "adam_ of visible rows", "observe_"])
def test_no_rows_are_no_error(name):
    operator, arguments = sound_calls()[name]

    def none_of(value: Any) -> Any:
        if isinstance(value, list):
            return [none_of(one) for one in value]
        return value[:0] if torch.is_tensor(value) and value.dim() and value.dtype != torch.int64 else value

    operator(*map(none_of, arguments))
