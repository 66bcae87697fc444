"""Trained models that the tests of exports share, and export.py as a call."""

from collections.abc import Callable
from pathlib import Path

import pytest

import export
import train
from applications.demo.make_scene import make_scene
from scene.saved_model import load_saved
from scene.scene import Scene


def _train(once, iterations: int) -> Path:
    """Return the folder of a model of the traced scene."""

    def make(folder: Path) -> None:
        make_scene(folder / "scene", 14, 80, 60, 1500, 0)
        words = f"--iterations {iterations} --densify_from_iter 100 --test_iterations -1 --quiet --eval --no_curve"
        train.main(["-s", str(folder / "scene"), "-m", str(folder / "model"), "--disable_viewer", *words.split()])

    return once(f"traced {iterations}", make) / "model"


def _load(model: Path) -> Scene:
    parser, models, _ = export.options()
    return load_saved(models.extract(export.parse(parser, ["-m", str(model), "--to", "a.ply"])), -1)


@pytest.fixture(scope="session")
def traced(once) -> Path:
    """The folder of a model of the traced scene."""
    return _train(once, 1000)


@pytest.fixture(scope="session")
def traced_scene(traced: Path) -> Scene:
    """The traced scene with its model."""
    return _load(traced)


@pytest.fixture(scope="session")
def early(once) -> Path:
    """The folder of a model of fewer iterations, for tests that are not slow."""
    return _train(once, 400)


@pytest.fixture(scope="session")
def early_scene(early: Path) -> Scene:
    """The traced scene with that model."""
    return _load(early)


@pytest.fixture
def run_export(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """A call of export.py with words."""

    def run(*words: object) -> None:
        monkeypatch.setattr("sys.argv", ["export.py", *map(str, words)])
        export.main()

    return run
