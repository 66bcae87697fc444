"""The progress bar of training."""

from types import SimpleNamespace

from splatting.training.objective import LossWatch
from splatting.training.observers.report import ProgressBar
from splatting.training.schedule import Schedule


def test_the_number_of_gaussians_is_exact(capsys):
    run = SimpleNamespace(
        losses=LossWatch(), dataset=SimpleNamespace(depths=""), first_iteration=0,
        schedule=Schedule(20), gaussians=SimpleNamespace(gaussian_count=123_456), clock=SimpleNamespace(seconds=1.0),
        opt=SimpleNamespace(time_budget=0.0),
    )  # fmt: skip
    bar = ProgressBar(run)
    bar.measured(SimpleNamespace(iteration=10, due=True, span=range(10, 11)), SimpleNamespace(depth=None))
    bar.ended(None)
    assert "Gaussians=123,456" in capsys.readouterr().err
