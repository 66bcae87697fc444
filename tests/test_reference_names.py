"""The names of the reference: each is here, takes the arguments of both releases, and stands on the page."""

import argparse
import ast
import inspect
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import pytest

CONTRACT = Path(__file__).with_name("reference_names.txt")
SHORT = {
    "GaussianModel": "scene.gaussian_model.GaussianModel",
    "Scene": "scene.Scene",
    "Camera": "scene.cameras.Camera",
}
ABSENT, VALUE, SAME = "–", "yes", "="


class Name(NamedTuple):
    """A line of the contract."""

    name: str
    release2023: str
    release2024: str


def _rows() -> list[Name]:
    lines = CONTRACT.read_text(encoding="utf-8").splitlines()
    cells = [line.split(" | ") for line in lines if line and not line.startswith("#")]
    return [Name(name, first, first if second == SAME else second) for name, first, second in cells]


def _resolve(dotted: str) -> object:
    """The object of a dotted name, whose first parts are modules."""
    first, _, rest = dotted.partition(".")
    dotted = f"{SHORT[first]}.{rest}" if first in SHORT else dotted
    parts = dotted.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found = import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            found = getattr(found, part)
        return found
    raise ImportError(dotted)


@pytest.fixture(scope="session")
def instances(tmp_path_factory: pytest.TempPathFactory, _colmap_master: Path) -> dict[str, object]:
    """A scene with its first camera and its model, as training has them."""
    from arguments import ModelParams, OptimizationParams
    from scene import GaussianModel, Scene

    parser = argparse.ArgumentParser()
    model, optimisation = ModelParams(parser), OptimizationParams(parser)
    args = parser.parse_args(["-s", str(_colmap_master), "-m", str(tmp_path_factory.mktemp("model"))])
    gaussians = GaussianModel(3)
    scene = Scene(model.extract(args), gaussians)
    gaussians.training_setup(optimisation.extract(args))
    return {"GaussianModel": gaussians, "Scene": scene, "Camera": scene.getTrainCameras()[0]}


def _bind(signature: inspect.Signature, cell: str, bound_to_class: bool) -> None:
    """Bind the arguments of a cell by position and by keyword; check the defaults."""
    arguments = ast.parse(f"def f{cell}: pass").body[0].args
    names = [argument.arg for argument in arguments.args]
    itself = [object()] if bound_to_class else []
    signature.bind(*itself, *names)
    required = names[: len(names) - len(arguments.defaults)]
    signature.bind(*itself, *required)
    if any(parameter.kind is parameter.VAR_POSITIONAL for parameter in signature.parameters.values()):
        return  # told apart at the call; tests of its own call it
    for name, node in zip(names[len(required) :], arguments.defaults, strict=True):
        parameter = signature.parameters.get(name)
        if parameter is not None and (default := ast.literal_eval(node)) is not None:
            wanted = tuple(default) if isinstance(default, list) else default
            assert parameter.default == wanted, (name, parameter.default, wanted)


ROWS = _rows()


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_a_name_of_the_reference_is_here(row, instances):
    first, _, attribute = row.name.partition(".")
    if first in SHORT:
        assert hasattr(instances[first], attribute)
    else:
        _resolve(row.name)
    for cell in {row.release2023, row.release2024} - {ABSENT, VALUE}:
        method = first in SHORT or row.name.split(".")[-2][0].isupper()
        _bind(inspect.signature(_resolve(row.name)), cell, method)
