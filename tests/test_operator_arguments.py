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
from rasterizer_tools import BOTH_AND_GPU, moved_by_a_word
from torch import Tensor, library

ROOT = Path(__file__).parents[1]
REPORT = """
import sys
sys.path[:0] = ["tests", "."]
import splatting.host.openmp
from fuzz.operators import outcomes
for outcome in outcomes():
    print("|".join(outcome), flush=True)
"""
RASTERIZER = ("project", "bin", "blend", "blend_vjp", "project_vjp", "rasterize", "rasterize_vjp", "mark_visible")
RASTERIZER += ("blend_rows", "rows_vjp", "pack_splats_", "unpack_splats", "move_runs", "sum_runs")
NEEDLESS = ("means2d", "grad_transmittance", "grad_inverse_depth", "stopped", "words")  # tensors that may be None


@pytest.fixture(scope="module")
def outcomes() -> dict[tuple[str, str], str]:
    """Errors by operator and change; made in another process, because a crash would end this one."""
    done = subprocess.run([sys.executable, "-c", REPORT], cwd=ROOT, capture_output=True, text=True)
    lines = [line.split("|") for line in done.stdout.splitlines()]
    assert done.returncode == 0, f"status {done.returncode} in the change after {lines[-1] if lines else 'none'}"
    return {(name, words): outcome for name, words, outcome in lines}


@cache
def _calls() -> dict[str, Call]:
    return sound_calls()


def _argument(name: str, words: str) -> str:
    """Name of the argument that was changed."""
    place = int(words.split()[1].partition("[")[0])
    return _calls()[name][0].default._schema.arguments[place].name


def test_there_are_as_many_as_operators(outcomes):
    registered = {name for name in torch._C._dispatch_get_all_op_names() if "::" in name}
    ours = {name for name in registered if name.startswith(("diff_gaussian", "fused_ssim", "simple_knn"))}
    assert {name.partition("::")[2] for name in ours} == {name for name, _ in outcomes} and len(outcomes) > 1500


def test_none_is_an_error(outcomes):
    for (name, words), outcome in outcomes.items():
        if words.endswith(" is None") and _argument(name, words) not in NEEDLESS:
            assert outcome.endswith("Error"), (name, words)
            if name in RASTERIZER:
                assert outcome in ("TypeError", "ValueError"), (name, words, outcome)


def test_other_dtypes_and_layouts_are_errors(outcomes):
    wrong = ("float16", "int64", "int32", "bool", "complex64", "sparse", "a number")
    for (name, words), outcome in outcomes.items():
        if words.endswith(wrong):
            assert outcome.endswith("Error"), (name, words)


def test_other_ranks_are_errors(outcomes):
    for (name, words), outcome in outcomes.items():
        if name in RASTERIZER and words.endswith(("one more axis", "is a scalar", "no columns", "one column more")):
            if _argument(name, words) in ("slots", "instances", "layers") and not words.endswith(("axis", "scalar")):
                continue  # they have no columns
            if _argument(name, words) == "like":
                continue  # only its dtype counts
            assert outcome in ("ValueError", "RuntimeError"), (name, words, outcome)


# Operators without a kernel for shapes alone: nobody compiles them.
UNCOMPILED = {"run_ahead_", "is_in_host_memory", "photometric_band", "photometric_of_sums", "photometric_band_vjp"}
NOT_ON_GPU = {"in_host_memory", "step_now_", "catch_up_", "penalise_"}
TRAINED = {  # inputs that have a gradient
    "rasterize": ("means2d", "means", "opacities", "scales", "rotations", "sh_dc", "sh_rest"),
    "l1_ssim": ("img1",),
    "photometric": ("image",),
}
UNGUARDED = {"loss": None, "stopped": None, "iteration": 0}
VARIANTS = {
    "rasterize": [{"inverse_depth": depth, "train": train} for depth in (False, True) for train in (False, True)],
    "blend": [{"inverse_depth": False, "train": False}, {}],
    "bin": [{"train": False}, {}],
    "adam_": [UNGUARDED, {}],
    "sparse_adam_": [UNGUARDED, {}],
    "blend_rows": [{"absolute": False}, {}],
    "l1_ssim": [{"train": False}, {}],
    "photometric": [{"train": False}, {}],
    "mean_distance2": [{"points": lambda t: t[:0]}, {}],
}
CHECKED = [(name, changes) for name in sorted(sound_calls()) for changes in VARIANTS.get(name, [{}])]


def _named(call: Call, changes: dict[str, Any]) -> dict[str, Any]:
    """The arguments of a call by name. changes: others in their place, or functions of them."""
    operator, arguments = call
    names = [argument.name for argument in operator.default._schema.arguments]
    named = dict(zip(names, arguments, strict=False))
    return named | {name: new(named[name]) if callable(new) else new for name, new in changes.items()}


@BOTH_AND_GPU
@pytest.mark.parametrize(
    ("name", "changes"), CHECKED, ids=lambda value: value if isinstance(value, str) else "-".join(value)
)
def test_opcheck(name, changes, device, dtype):
    if name in UNCOMPILED or (device == "cuda" and name in NOT_ON_GPU):
        pytest.skip("has no kernel for shapes alone, or its tensors lie on the CPU")
    call = sound_calls(device, dtype)[name]
    named = _named(call, changes)
    train = named.get("train", False) and name != "bin"
    for trained in TRAINED.get(name, ()) if train else ():
        named[trained].requires_grad_()
    checks = ["test_schema", "test_autograd_registration", "test_faketensor", "test_aot_dispatch_dynamic"]
    # On a GPU nobody writes all of what is kept for a backward, so that no two calls agree there.
    library.opcheck(call[0].default, (), named, test_utils=checks[:3] if device == "cuda" and train else checks)


def _integers(*numbers: int) -> Tensor:
    return torch.tensor(numbers, dtype=torch.int32)


def _transposed(tensor: Tensor) -> Tensor:
    return tensor.T.contiguous().T


def _sums(counts: tuple, kept: tuple, room: int = 3, values: int = 10) -> dict:
    return {"rows": torch.rand(5, values), "counts": _integers(*counts), "kept": _integers(*kept), "room": room}


def _runs(counts: tuple, places: tuple, values: int = 10) -> dict:
    return {"rows": torch.rand(5, values), "counts": _integers(*counts), "places": _integers(*places)}


def _unseen(count: int) -> dict:
    return {"tile_counts": _integers(0, 2, 2), "counts": _integers(count, 4 - count, 2)}


OF_PARAMETER = "shape, dtype and device of the parameter"
OF_GRADIENT = r"the gradient must be \(3, 3\) float32 on cpu, or its lengths \(3,\), got "
OF_VISIBLE = r"visible must be \(3\) bool on cpu, got"
IN_ORDER = "places must be the numbers from 0 to 1 in any order, got "
WRONG = {
    "adam_": [
        (RuntimeError, OF_PARAMETER, {"gradients": lambda t: [t[0], t[1].T]}),
        (RuntimeError, OF_PARAMETER, {"gradients": lambda t: [t[0].double(), t[1]]}),
        (RuntimeError, "must be contiguous", {"values": lambda t: [_transposed(t[0]), t[1]]}),
        (RuntimeError, "columns must be at most 3, got 4", {"columns": [4, -1]}),
        (RuntimeError, "for each of the 2 parameters, got 1", {"rates": [0.1]}),
        (RuntimeError, "step counter must be one float32 on the CPU", {"steps": lambda t: [t[0].int(), t[1]]}),
    ],
    "sparse_adam_": [
        (RuntimeError, OF_VISIBLE, {"visible": torch.ones(4, dtype=torch.bool)}),
        (RuntimeError, OF_VISIBLE, {"visible": torch.ones(3)}),
        (RuntimeError, OF_VISIBLE, {"visible": torch.ones(3, 1, dtype=torch.bool)}),
        (RuntimeError, OF_PARAMETER, {"gradient": lambda t: t[:, :2]}),
        (RuntimeError, "columns must be at most 3, got 4", {"columns": 4}),
    ],
    "observe_": [
        (RuntimeError, "statistics must be 3 float32 on cpu, got .2", {"max_radii": torch.zeros(2)}),
        (RuntimeError, "statistics must be contiguous", {"max_radii": torch.zeros(6)[::2]}),
        (RuntimeError, "radii must be int32, got torch.float32", {"radii": torch.ones(3)}),
        (RuntimeError, rf"{OF_GRADIENT}\(3, 2\) torch.float32", {"gradient": torch.ones(3, 2)}),
        (RuntimeError, rf"{OF_GRADIENT}\(2,\)", {"gradient": torch.ones(2)}),
    ],
    "pack_splats_": [
        (ValueError, r"packed must be \(3, 16\)", {"packed": lambda t: t[1:]}),
        (TypeError, "packed must be torch.int32", {"packed": Tensor.float}),
        (ValueError, "packed must be contiguous", {"packed": _transposed}),
        (ValueError, "packed must begin at a multiple of 16 bytes", {"packed": moved_by_a_word}),
        (TypeError, "gaussians must be torch.int64", {"gaussians": Tensor.int}),
        (ValueError, "gaussians must be from 0 to 2, got 9", {"gaussians": torch.tensor([2, 9, 1])}),
        (ValueError, "gaussians must be from 0 to 2, got -1", {"gaussians": torch.tensor([2, 1, -1])}),
    ],
    "unpack_splats": [
        (ValueError, r"packed must be \(-1, 27\)", {"like": Tensor.double}),
        (TypeError, "like must be float32 or float64, got torch.int32", {"like": Tensor.int}),
    ],
    "list_records": [
        (ValueError, "tile_counts must be", {"tile_counts": lambda t: t[1:]}),
        (ValueError, r"limits must be \(2, -1", {"limits": lambda t: t[0]}),
        (TypeError, "limits must be torch.int32", {"limits": Tensor.long}),
        (ValueError, r"counts must be \(3, 1", {"counts": lambda t: t[:-1]}),
        (ValueError, "records by band, and to .* of all", {"counts": lambda t: t[[0, 1, 1]]}),
        (ValueError, "counts must be 0 or more, got -1", {"counts": lambda t: t.clone().fill_(-1)}),
        (RuntimeError, "a room of 2147483648 is not from 0 to 2", {"room": 2**31}),
    ],
    "sum_runs": [
        (ValueError, r"rows must be \(R, 10\) or \(R, 12\), got \(5, 11\)", _sums((5,), (1,), values=11)),
        (ValueError, r"kept must be \(2,\)", _sums((3, 2), (1,))),
        (ValueError, "counts add up to 4, but there are 5 rows", _sums((3, 1), (1, 1))),
        (ValueError, "counts must be 0 or more, got -1 of run 1", _sums((6, -1), (1, 1))),
        (ValueError, "kept must be 0, 1 or the run's count, got 2 of run 0", _sums((3, 2), (2, 2))),
        (ValueError, "kept adds up to 4 rows, for which a room of 3 is too small", _sums((3, 2), (3, 1))),
        (RuntimeError, "a room of -1 is not from 0 to 2", _sums((3, 2), (1, 1), room=-1)),
    ],
    "sum_parts": [
        (ValueError, "sizes add up to 4, but there are 3 counts", {"sizes": [3, 1]}),
        (ValueError, "sizes must be 0 or more, got -1", {"sizes": [4, -1]}),
        (TypeError, "counts must be torch.int32", {"counts": Tensor.float}),
    ],
    "move_runs": [
        (ValueError, r"rows must be \(R, 10\) or \(R, 12\), got \(5, 11\)", _runs((5,), (0,), 11)),
        (TypeError, "rows must be float32 or float64", {"rows": Tensor.int}),
        (ValueError, r"places must be \(2,\)", _runs((3, 2), (0,))),
        (ValueError, "counts add up to 4, but there are 5 rows", _runs((3, 1), (0, 1))),
        (ValueError, "counts must be 0 or more, got -1 of run 1", _runs((6, -1), (0, 1))),
        *((ValueError, f"{IN_ORDER}{place} of run 1", _runs((3, 2), (0, place))) for place in (0, 2, -1)),
    ],
    "rows_vjp": [
        (ValueError, r"rows must be \(-1, 12\)", {"absolute": True}),
        (ValueError, r"rows must be \(-1, 10\)", {"rows": lambda t: t[:, :9]}),
        (TypeError, "rows must be torch.float32", {"rows": Tensor.double}),
        (ValueError, r"counts must be \(3,\)", {"counts": lambda t: t[1:]}),
        (TypeError, "counts must be torch.int32", {"counts": Tensor.long}),
        (ValueError, "counts add up to 7, but there are 6 rows", {"counts": lambda t: t + _integers(0, 1, 0)}),
        (ValueError, "there are 5 rows", {"rows": lambda t: t[1:]}),
        *((ValueError, f"got {count} of splat 0", _unseen(count)) for count in (1, -1)),
    ],
    "rows_vjp_add_": [
        (ValueError, "sums must have 9 tensors, got 8", {"sums": lambda t: t[:8]}),
        (ValueError, r"the sum of means must be \(3, 3\)", {"sums": lambda t: [t[0][1:], *t[1:]]}),
        (TypeError, "the sum of sh_rest must be torch.float32", {"sums": lambda t: [*t[:8], t[8].double()]}),
        (ValueError, "the sum of means must be contiguous", {"sums": lambda t: [_transposed(t[0]), *t[1:]]}),
    ],
    "rasterize_vjp_step_": [
        (RuntimeError, "for each of the 6 attributes, got 5", {"rates": [0.1] * 5}),
        (RuntimeError, "different numbers from 0 to 5", {"attributes": [0, 1, 2, 3, 4, 4]}),
        (RuntimeError, "different numbers from 0 to 5", {"attributes": [0, 1, 2, 3, 4, 6]}),
        (RuntimeError, "columns must be at most 45, got 46", {"columns": [-1] * 5 + [46]}),
        (RuntimeError, OF_PARAMETER, {"exp_avg": lambda t: [*t[:5], t[0]]}),
        (RuntimeError, OF_PARAMETER, {"exp_avg_sq": lambda t: [*t[:5], t[5].double()]}),
        (RuntimeError, "must be contiguous", {"means": _transposed}),
        (RuntimeError, "must be contiguous", {"exp_avg": lambda t: [_transposed(t[0]), *t[1:]]}),
        (RuntimeError, "step counter must be one float32 on the CPU", {"steps": lambda t: [*t[:5], torch.ones(2)]}),
        (RuntimeError, "statistics must be 3 float32", {"views": torch.ones(2)}),
        (RuntimeError, "statistics must be contiguous", {"views": torch.ones(6)[::2]}),
        (RuntimeError, "max_radii, gradient_sums and views, or none", {"views": None}),
        (RuntimeError, "a guarded step needs the loss", {"loss": None}),
        (RuntimeError, "stopped must be one int64", {"stopped": torch.zeros(1)}),
        (RuntimeError, "count from 1", {"iteration": 0}),
        (TypeError, "radii must be", {"radii": torch.ones(3)}),
        (ValueError, "radii must be", {"radii": _integers(1, 1)}),
        (ValueError, "tile_counts must be", {"tile_counts": _integers(1, 1)}),
        (ValueError, "now must be contiguous", {"now": torch.zeros(44, dtype=torch.int64)[::2]}),
        (ValueError, "now must be", {"now": torch.zeros(21, dtype=torch.int64)}),
        (ValueError, "penalties are of raw Gaussians", {"raw": False, "scale_penalty": 0.1}),
        (ValueError, "not cov3d or colors", {"sh_dc": None, "sh_rest": None, "colors": torch.rand(3, 3)}),
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
    call = sound_calls(dtype=torch.float64)["rasterize_vjp_step_"]
    statistics = {"max_radii": torch.ones(3), "gradient_sums": torch.ones(3, 1), "views": torch.ones(3, 1)}
    with pytest.raises(RuntimeError, match="statistics are of float32 Gaussians"):
        call[0](**_named(call, statistics))


@pytest.mark.parametrize("name", ["adam_", "sparse_adam_", "observe_"])
def test_no_rows_are_no_error(name):
    operator, arguments = sound_calls()[name]

    def none_of(value: Any) -> Any:
        if isinstance(value, list):
            return [none_of(one) for one in value]
        return value[:0] if torch.is_tensor(value) and value.dim() and value.dtype != torch.int64 else value

    operator(*map(none_of, arguments))
