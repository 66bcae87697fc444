"""The progress bar of training."""

import io
from itertools import count
from types import SimpleNamespace

import pytest
from tqdm import tqdm

from splatting.host.progress import Bar
from splatting.training.log import ProgressBar
from splatting.training.objective import LossWatch
from splatting.training.schedule import Schedule


@pytest.mark.parametrize("seconds", [0.0, 4.0])
def test_a_log_gets_a_line_in_ten_seconds_and_a_last_one(monkeypatch, seconds):
    log, now = io.StringIO(), iter(count(0.0, seconds))
    monkeypatch.setattr("splatting.host.progress.time", SimpleNamespace(monotonic=lambda: next(now)))
    for _ in Bar(range(30), file=log, desc="Looking", mininterval=0, miniters=1):
        tqdm.write("other", file=log)
    lines = [line for line in log.getvalue().split("\n") if line != "other"]
    assert lines[-1] == "" and lines[-2].startswith("Looking: 100%") and "\r" not in log.getvalue()
    assert "0%|  " not in lines[0] and len(lines) == (2 if not seconds else len(set(lines)))
    assert not seconds or 5 < len(lines) < 40

    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    for _ in Bar(range(3), file=(shown := Terminal())):
        pass
    assert "0%" in shown.getvalue() and "100%" in shown.getvalue()


def test_the_number_of_gaussians_is_exact(capsys):
    run = SimpleNamespace(
        losses=LossWatch(), parts=[], first_iteration=0,
        schedule=Schedule(20), gaussians=SimpleNamespace(gaussian_count=123_456), clock=SimpleNamespace(seconds=1.0),
        opt=SimpleNamespace(time_budget=0.0),
    )  # fmt: skip
    bar = ProgressBar(run)
    bar.measured(SimpleNamespace(iteration=10, due=True, span=range(10, 11)), SimpleNamespace(terms={}))
    bar.ended(None)
    assert "Gaussians=123,456" in capsys.readouterr().err
