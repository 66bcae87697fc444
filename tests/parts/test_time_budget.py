"""Training by the clock: it ends when its seconds are over, goes through the whole schedule, and can be repeated."""

import json
import math
import random
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from gaussians import options
from trainings import LEARNT, PART_OPTIONS, before_steps, narrow_scene, train_on

from scene.gaussians import density_rules as rules
from splatting.features import time_budget
from splatting.features.time_budget import Sizes
from splatting.features.time_budget_file import read_schedule, schedule_of, write_schedule
from splatting.features.time_budget_schedule import Block, Decided, DecidedSchedule, TimeBudget
from splatting.iteration import Iteration
from splatting.log import ProgressBar
from splatting.records.training_log import Stopwatch
from splatting.registry import strategies, strategy_part
from splatting.run import Run
from splatting.schedule import Schedule, stride_rate_factor
from utils.system_utils import UserError

OPTIONS = ["-r", 24, "--eval", "--no_curve", "--test_iterations", -1, "--densify_grad_threshold", 1e-4,
           "--densification_interval", 5, "--max_num_splats", 400, "--iterations", 3000]  # fmt: skip
CONTINUED = {  # options with states of their own, as many as one training can have
    "halves": ("--plain_step", *PART_OPTIONS["exposure"], *PART_OPTIONS["refine_poses"], *PART_OPTIONS["robust_mask"]),
    "mcmc": ("--strategy", "mcmc", *PART_OPTIONS["ppisp"]),
}


def _fresh(length: int, budget: float) -> TimeBudget:
    return TimeBudget(Decided(length, [], None, budget, levels=()))


def _run(
    schedule: Schedule, cost: Callable[[int, int], float], first: int = 0, seconds: float = 0.0
) -> tuple[int, float]:
    """Take iterations of cost(iteration, step) seconds until the last: its number, and the seconds then."""
    iteration = first
    while not iteration or not schedule.is_last(iteration):
        iteration += 1
        schedule.reach(iteration, seconds)
        seconds += cost(iteration, schedule.schedule_step(iteration))
    return iteration, seconds


def _noisy(iteration: int, step: int) -> float:
    return 0.01 * random.Random(iteration).uniform(0.5, 1.5)


COSTS = {
    "constant": lambda t, n: 0.01,
    "noisy": _noisy,
    "a slow start": lambda t, n: 3.0 if t == 1 else 0.005,
    "growth": lambda t, n: 0.002 * (1 + 20 * min(1.0, n / 15_000)),
    "sudden growth": lambda t, n: 0.002 if n < 20_000 else 0.03,
    "faster than the schedule": lambda t, n: 0.0001,
    "few iterations": lambda t, n: 0.25 if t % 2 else 0.2,
    "dear events": lambda t, n: 0.01 + 0.1 * (t % 100 == 0),
}


def _factors(schedule: Schedule, last: int) -> list[float]:
    sizes = Sizes(schedule, None)
    return [sizes.factor_at(schedule.schedule_step(t)) for t in range(1, last + 1)]


@pytest.mark.parametrize(("megapixels", "name"), [(0.5, "pyramid"), (0.15, "none")])
def test_a_budget_of_few_pixels_takes_smaller_views_at_first(megapixels, name):
    """Its schedule repeats them, also those before the decision; a run that has begun otherwise stays as it is."""
    schedule = TimeBudget(Decided(30_000, [], None, 30.0, "auto"))
    schedule.megapixels = megapixels
    seen: list[float] = []

    def seconds(iteration: int, step: int) -> float:
        seen.append(Sizes(schedule, None).factor_at(step))
        return 0.02 / seen[-1]

    last, _ = _run(schedule, seconds)
    recorded = schedule.up_to(last)
    assert recorded.sizes == schedule.sizes == name and _factors(DecidedSchedule(recorded), last) == seen
    assert list(dict.fromkeys(seen)) == ([1.0, 4.0, 2.0] if name == "pyramid" else [1.0])  # at last whole again
    assert seen[0] == seen[-1] == 1.0
    resumed = TimeBudget(DecidedSchedule(recorded).up_to(last // 2)._replace(time_budget=30.0))
    _run(resumed, lambda t, n: 0.1, first=last // 2, seconds=15.0)
    assert resumed.levels == schedule.levels
    late = TimeBudget(Decided(30_000, [Block(6_000, 0.0, 1 / 30_000, 0.0)], None, 30.0, "auto"))
    late.megapixels = 100.0
    _run(late, lambda t, n: 0.1, first=6_000)
    assert late.levels == () and late.sizes == "none"


@pytest.mark.parametrize(("name", "budget"), [("constant", 20.0), ("growth", 20.0), *((name, 5.0) for name in COSTS)])
def test_it_ends_within_three_percent_and_goes_through_the_whole_schedule(name, budget):
    schedule = _fresh(30_000, budget)
    last, seconds = _run(schedule, COSTS[name])
    assert seconds == pytest.approx(budget, rel=0.03)
    steps = [schedule.schedule_step(t) for t in range(last + 1)]
    assert steps == sorted(steps) and steps[0] == 0 and steps[-1] == 30_000 > steps[-2]
    spans = [t for iteration in range(1, last + 1) for t in schedule.span(iteration)]
    assert spans == list(range(1, 30_001))  # each iteration of the schedule once
    assert len(schedule.blocks) < 420


@pytest.mark.parametrize(
    ("at", "lost", "total"), [(200, 3.0, 10.0), (300, 6.5, 13.0), (300, 15.0, 21.5), (980, 5, 14.9)]
)
def test_lost_seconds_do_not_make_an_iteration_do_more_than_twice_its_part(capsys, at, lost, total):
    """Its part is a thousandth, as it takes 0.01 s of 10. What is left undone then takes half of its usual seconds."""
    schedule = _fresh(30_000, 10.0)
    last, seconds = _run(schedule, lambda t, n: 0.01 + lost * (t == at))
    assert max(schedule.stride(t) for t in range(1, last + 1)) <= 2 * 30_000 / 1000 * 1.001
    assert schedule.schedule_step(last) == 30_000 and len(schedule.blocks) < 420
    assert seconds == pytest.approx(total, abs=0.1)
    assert capsys.readouterr().err.count("training will take about") == (total > 10)


def test_an_iteration_that_takes_longer_than_the_budget_is_followed_by_the_last(capsys):
    schedule = _fresh(30_000, 1.0)
    assert _run(schedule, lambda t, n: 5.0) == (2, 10.0)
    assert "--time_budget 1 is too short for 3 iterations" in capsys.readouterr().err
    assert _run(_fresh(1, 1.0), lambda t, n: 5.0)[0] == 2
    assert _run(_fresh(1, 1.0), lambda t, n: 0.1)[0] == 10
    assert capsys.readouterr().err.count("\n") == 1


def test_a_resumed_run_goes_on_from_its_place_with_the_seconds_that_are_left(tmp_path):
    whole = _fresh(30_000, 10.0)
    at, seconds = 0, 0.0
    while seconds < 4.0:
        at += 1
        whole.reach(at, seconds)
        seconds += _noisy(at, 0)
    assert at != whole.blocks[-1].last  # within a block
    write_schedule(tmp_path / "schedule.json", whole.up_to(at))
    before = read_schedule(tmp_path / "schedule.json")
    assert before.ended is None
    schedule = TimeBudget(before)
    last, ended = _run(schedule, lambda t, n: 2 * _noisy(t, n), at, seconds)
    assert ended == pytest.approx(10.0, rel=0.03) and 250 < last - at < 350
    assert [schedule.span(t) for t in range(1, at + 1)] == [whole.span(t) for t in range(1, at + 1)]
    assert schedule.schedule_step(at + 1) - schedule.schedule_step(at) < 200
    late = TimeBudget(before)  # nothing is left
    assert _run(late, _noisy, at, 11.0)[0] == at + 1


GOOD = {
    "blocks": [
        {"last": 2, "seconds": 0.0, "start": 0.0, "step": 0.1}, {"last": 10, "seconds": 1.0, "start": 0.2, "step": 0.1}
    ],
    "ended": 10, "iterations": 100, "time_budget": 5.0, "resolution_schedule": "none", "levels": [],
}  # fmt: skip


def _with_block(index: int, **values: object) -> dict:
    blocks = [dict(block) for block in GOOD["blocks"]]
    blocks[index] |= values
    return GOOD | {"blocks": blocks}


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("{", "is not a valid schedule.json"),
        ({name: GOOD[name] for name in GOOD if name != "blocks"}, "'blocks' is missing"),
        (GOOD | {"iterations": 0}, "0 is no whole number from 1 to 2147483647"),
        (_with_block(1, last=2**70) | {"ended": 2**70}, "is no whole number from 1 to 2147483647"),
        (GOOD | {"strategy": "error_scores"}, "'error_scores' is no strategy"),
        (GOOD | {"blocks": []}, "its blocks do not follow each other"),
        (_with_block(1, start=-0.1), "-0.1 is no number from 0 on"),
        (_with_block(1, step=0.2), "its progress goes beyond its end"),
        (_with_block(0, start=0.3) | {"continued": [{"after": 3, "seconds": 1.0}]}, "its progress does not ascend"),
        (GOOD | {"continued": [{"after": 2}]}, "'seconds' is missing"),
        (GOOD | {"ended": 9}, "its last block does not end with its last iteration"),
        (json.dumps(GOOD).replace("5.0", "NaN"), "nan is no number"),
    ],
)
def test_a_broken_schedule_is_refused(tmp_path, content, reason):
    path = tmp_path / "schedule.json"
    path.write_text(json.dumps(GOOD))
    assert read_schedule(path).blocks[1] == Block(10, 0.2, 0.1, 1.0)
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(UserError, match=reason) as error:
        read_schedule(path)
    assert str(path) in str(error.value) and "name the schedule.json of a run with --time_budget" in str(error.value)


def _evenly(length: int, count: int) -> Decided:
    """A schedule that so many iterations go through in equal parts."""
    return Decided(length, [Block(count, 0.0, 1 / count, 0.0)], count, 9.0, levels=())


def _actions(stride: int, white: bool = False, **changed: int) -> dict[int, rules.Actions]:
    """Return the actions of adaptive density control in each iteration of a run of 30,000 steps.

    stride: steps that an iteration takes at once.
    """
    schedule, opt = DecidedSchedule(_evenly(30_000, 30_000 // stride)), options(**changed)
    every = range(1, schedule.ends + 1)
    return {t: rules.actions(t, opt, white, schedule.span(t), schedule.stride(t)) for t in every}


def test_windows_and_resets_are_of_the_schedule_and_densifications_of_the_run():
    todo = _actions(2)
    assert [t for t in todo if todo[t].densify] == list(range(300, 7500, 100))
    assert [t for t in todo if todo[t].reset_opacity] == [1500, 3000, 4500, 6000]
    assert min(t for t in todo if todo[t].limit_size) == 1501
    assert max(t for t in todo if todo[t].observe) == 7499
    white = _actions(2, white=True, densify_from_iter=501)
    assert [t for t in white if white[t].reset_opacity] == [251, 1500, 3000, 4500, 6000]


@pytest.mark.parametrize(
    ("stride", "changed", "densified", "resets"),
    [
        (1, {}, 144, None),
        (1, {"opacity_reset_interval": 200}, None, 75),  # as the user wants it
        (3, {}, None, 5),
        (4, {}, None, 0),
        (4, {"opacity_reset_interval": 5000}, None, 3),
        (5, {}, 28, None),
        (30, {}, 20, None),
        (30, {"densify_from_iter": 14_900}, 3, None),  # all that there are
    ],
)
def test_few_steps_densify_twenty_times_without_resets_that_they_do_not_recover_from(
    stride, changed, densified, resets
):
    todo = _actions(stride, white=densified is None, **changed).values()
    assert densified in (None, sum(one.densify for one in todo))
    assert resets in (None, sum(one.reset_opacity for one in todo))


def _noted(monkeypatch: pytest.MonkeyPatch, look: Callable[[Run, Iteration], object]) -> list:
    """Collect the results of `look` at the begin of each iteration, before it sets rates and SH degree."""
    found = []
    due = ProgressBar.due
    monkeypatch.setattr(
        ProgressBar, "due", lambda self, step: (found.append(look(self._run, step)), due(self, step))[1]
    )
    return found


def test_strategies_grow_within_windows_of_the_schedule(colmap_scene, tmp_path, monkeypatch):
    write_schedule(tmp_path / "two.json", _evenly(120, 60))
    counts = _noted(monkeypatch, lambda run, _: len(run.gaussians))
    words = "--iterations", 120, "--max_num_splats", 5000, "--densify_from_iter", 20, "--densify_until_iter", 80
    for strategy in (("mcmc", "--mcmc_growth", 0.02, "--mcmc_until_iter", 80), ("budget",)):
        out = tmp_path / strategy[0]
        _train(colmap_scene, out, "--schedule", tmp_path / "two.json", *words, "--strategy", *strategy)
    # Every fifth iteration would be 5 times, so they are more often.
    grown = [t for t in range(1, 120) if counts[t] > counts[t - 1]]
    assert grown == [*range(11, 40), *range(71, 100)] and len(counts) == 120
    assert counts[-1] == 25 * 60  # as many as so few iterations can train


RATES = [
    (("--strategy", "adc"), 1.0), (("--strategy", "budget"), 8.0),
    (("--strategy", "adc", "--schedule", "few.json"), 8.0),
]  # fmt: skip


@pytest.mark.parametrize(("words", "factor"), RATES)
def test_few_iterations_have_larger_rates_with_the_budget_or_a_clock(
    colmap_scene, tmp_path, monkeypatch, words, factor
):
    rates = _noted(monkeypatch, lambda run, _: {one["name"]: one["lr"] for one in run.gaussians.optimizer.param_groups})
    monkeypatch.chdir(tmp_path)
    write_schedule(Path("few.json"), _evenly(20, 20))
    _train(colmap_scene, tmp_path / "out", *words, "--max_num_splats", 500, "--iterations", 20, "--plain_step")
    first, later = rates[0], rates[10]
    names = "f_dc", "opacity", "scaling", "rotation"
    assert [later[name] / first[name] for name in names] == pytest.approx([factor] * 4)
    assert later["xyz"] < 1.01 * first["xyz"]
    assert (rates[-1]["opacity"] < 0.3 * later["opacity"]) == (factor > 1)


def _timed(monkeypatch: pytest.MonkeyPatch, cost: Callable[[int], float]) -> None:
    """Let an iteration take cost(iteration) seconds of training by a clock of its own."""
    now = [0.0]

    class Watch(Stopwatch):
        def __init__(self, *given: object) -> None:
            super().__init__(*given)
            now[0] = 0.0

        @property
        def seconds(self) -> float:
            return now[0]

    monkeypatch.setattr("splatting.run.Stopwatch", Watch)
    before_steps(monkeypatch, lambda step: now.append(now.pop() + cost(step.iteration)))


def _train(scene: Path, out: Path, *more: object) -> dict[int, bytes]:
    return train_on(scene, out, "--disable_viewer", *OPTIONS, *more)


def _checkpoints(out: Path) -> list[Path]:
    """Those of a folder, the last one at the end."""
    return sorted(out.glob("chkpnt*.pth"), key=lambda path: int(path.stem[6:]))


def _stored(out: Path, name: str) -> str:
    return json.loads((out / "model.json").read_text())[name]


def _last_record(out: Path) -> dict:
    return json.loads((out / "train_log.json").read_text())[-1]


def test_a_short_training_by_the_clock_begins_with_smaller_views_and_replays(
    colmap_scene, tmp_path, monkeypatch, capsys
):
    def trained(name: str, *more: object) -> dict[int, bytes]:
        return _train(colmap_scene, tmp_path / name, "-r", 1, "--iterations", 1200, *more)

    _timed(monkeypatch, lambda t: 0.04)
    monkeypatch.setattr("splatting.features.time_budget.SHORT", {"cpu": 0.01, "cuda": 0.01})  # for photos this small
    short = trained("short", "--time_budget", 4, "--checkpoint_iterations", 600)
    monkeypatch.undo()
    repeats = "--schedule", tmp_path / "short" / "schedule.json"
    assert trained("again", *repeats) == short
    names = [read_schedule(tmp_path / name / "schedule.json").sizes for name in ("short", "again")]
    assert names == ["pyramid", "pyramid"]
    checkpoint, _ = _checkpoints(tmp_path / "short")
    assert max(trained("resumed", *repeats, "--start_checkpoint", checkpoint).items()) == max(short.items())


def test_what_contradicts_itself_is_refused(colmap_scene, tmp_path):
    path = tmp_path / "schedule.json"

    def refused(reason: str, *more: object) -> None:
        with pytest.raises(UserError, match=reason):
            _train(colmap_scene, tmp_path / "out", "--schedule", path, *more)

    refused("cannot read .*schedule.json")
    path.write_text(json.dumps(GOOD))
    refused("was written for --iterations 100")
    more = "--iterations", 100
    refused("--time_budget and --schedule both set the schedule", *more, "--time_budget", 3)
    path.write_text(json.dumps(GOOD | {"ended": None}))
    refused("run not finished; resume it", *more)
    path.write_text("{}")
    refused("'iterations' is missing", *more)
    assert not (tmp_path / "out").exists()


def test_a_checkpoint_finds_its_place_or_is_refused(colmap_scene, tmp_path, monkeypatch):
    steady, clocked = tmp_path / "steady", tmp_path / "clocked"
    _timed(monkeypatch, lambda t: 0.0)  # a busy machine's seconds would be missing below
    _train(colmap_scene, steady, "--iterations", 60, "--checkpoint_iterations", 30)
    start = "--start_checkpoint", steady / "chkpnt30.pth"
    _timed(monkeypatch, lambda t: 0.1)
    saved = _train(colmap_scene, clocked, "--iterations", 60, *start, "--time_budget", 5, "--checkpoint_iterations", 59)
    first = json.loads((clocked / "schedule.json").read_text())["blocks"][0]
    assert first["last"] == 30 and first["step"] == 1 / 60  # half of the schedule is done
    assert max(saved) in (79, 80, 81)
    checkpoint, _ = _checkpoints(clocked)
    for reason, more in (
        ("so --iterations 60 leaves nothing to do", ("--iterations", 60)),
        ("was written for --iterations 60, not 61", ("--iterations", 61, "--time_budget", 9)),
    ):
        with pytest.raises(UserError, match=reason):
            _train(colmap_scene, tmp_path / "out", "--start_checkpoint", checkpoint, *more)
    for broken in ({}, {"blocks": []}, GOOD):  # the last ends before the checkpoint
        with pytest.raises(UserError, match=r"^the schedule in a.pth is broken \(.*\); give another one$"):
            schedule_of(options(time_budget=9.0), "a.pth", 30, before=broken)


def test_a_decided_run_goes_through_rates_degrees_and_windows(colmap_scene, tmp_path, monkeypatch):
    """40 iterations stand for 4000: the first tenth of the run for the first 400."""

    def look(run: Run, step: Iteration) -> tuple[float, int, bool]:
        return run.gaussians.position_learning_rate, run.gaussians.active_sh_degree, step.changes

    path, steps = tmp_path / "schedule.json", [*range(80, 1601, 80), *range(1720, 4001, 120)]
    write_schedule(path, Decided(4000, [Block(20, 0.0, 0.02, 0.0), Block(40, 0.4, 0.03, 0.0)], 40, 0.0, levels=()))
    found = _noted(monkeypatch, look)
    words = "--position_lr_max_steps", 4000, "--densify_from_iter", 400, "--densify_until_iter", 2000
    _train(colmap_scene, tmp_path / "out", "--schedule", path, "--iterations", 4000, *words)
    rates, degrees, changes = zip(*found, strict=True)
    expected = [0.01 ** ((step - steps[0]) / 4000) for step in steps[:-1]]
    assert [rate / rates[1] for rate in rates[1:]] == pytest.approx(expected, rel=1e-6)
    # All in the window, as every fifth would be too few; and where the SH degree is raised.
    assert [t for t, change in enumerate(changes, 1) if change] == [*range(6, 25), 32]
    assert [t for t in range(1, 40) if degrees[t] > degrees[t - 1]] == [13, 24, 32]  # after 1000, 2000 and 3000


def test_a_finished_training_gets_more_seconds_and_its_schedule_repeats_all(
    colmap_scene, tmp_path, monkeypatch, capsys
):
    """Twice, and stopped between. Its rates are low from the start, and fall again."""
    out, every = tmp_path / "out", ("--random_background", "--iterations", 3000)
    rates = _noted(monkeypatch, lambda run, at: (at.iteration, run.schedule.rate_factor(at.iteration)))
    with monkeypatch.context() as timed:
        _timed(timed, lambda t: 0.1)
        first = max(_train(colmap_scene, out, *every, "--time_budget", 4))
        assert f"chkpnt{first}.pth" in (said := capsys.readouterr().out) and "--resume with --time_budget" in said
        again = *every, "--resume", "--time_budget"
        second = max(_train(colmap_scene, out, *again, 3, "--checkpoint_iterations", 2800))
        assert second - first in (29, 30, 31) and _last_record(out)["seconds"] == pytest.approx(7, abs=0.11)
        said = capsys.readouterr()
        assert "(budget 7 s, " in said.out and "was trained with" not in said.err
        found = dict(rates)
        assert max(found[t] for t in range(first + 1, second)) < 0.4 * found[20] and found[second] <= found[first]
        middle = _checkpoints(out)[1]
        assert first < int(middle.stem[6:]) < second
        on = _train(colmap_scene, tmp_path / "on", *again[:-2], "--start_checkpoint", middle, "--time_budget", 3)
        assert max(on) in range(second - 2, second + 3)  # what is left of the 3 seconds
        capsys.readouterr()
        third = max(saved := _train(colmap_scene, out, *again, 2))
        assert third - second in (19, 20, 21)
    repeated = _train(colmap_scene, tmp_path / "b", *every, "--schedule", out / "schedule.json")
    assert repeated[third] == saved[third]
    with pytest.raises(UserError, match="there is nothing left to train"):
        _train(colmap_scene, tmp_path / "c", *every, "--schedule", out / "schedule.json", "--start_checkpoint",
               out / f"chkpnt{third}.pth")  # fmt: skip
    assert read_schedule(tmp_path / "b" / "schedule.json") == read_schedule(out / "schedule.json")
    assert [one.after for one in read_schedule(out / "schedule.json").continued] == [first, second]


@pytest.mark.parametrize("more", CONTINUED.values(), ids=CONTINUED)
def test_what_trains_beside_the_gaussians_is_repeated_where_a_training_was_continued(tmp_path, monkeypatch, more):
    """The iteration in which it ended first takes no step, and leaves no gradient to the next one."""
    scene = narrow_scene(tmp_path / "scene")
    words = "--iterations", 300, "--antialiasing", "--densify_from_iter", 20, *more
    with monkeypatch.context() as timed:
        _timed(timed, lambda t: 0.1)
        _train(scene, tmp_path / "out", *words, "--time_budget", 1)
        saved = _train(scene, tmp_path / "out", *words, "--resume", "--time_budget", 1)
    repeated = _train(scene, tmp_path / "again", *words, "--schedule", tmp_path / "out" / "schedule.json")
    assert repeated[max(repeated)] == saved[max(repeated)]
    for name in LEARNT:
        one, other = (tmp_path / folder / name for folder in ("out", "again"))
        assert one.exists() == other.exists() and (not one.exists() or one.read_bytes() == other.read_bytes())


def test_a_steady_run_goes_on_from_a_checkpoint_of_a_budget_and_removes_the_schedule(
    colmap_scene, tmp_path, monkeypatch, capsys
):
    """Earlier checkpoints keep their place in it; its own are of no schedule."""
    out, path = tmp_path / "out", tmp_path / "out" / "schedule.json"
    _timed(monkeypatch, lambda t: 0.1)
    whole = _train(colmap_scene, out, "--iterations", 60, "--checkpoint_iterations", 20, 40, "--time_budget", 5)
    before, (_, late, _) = read_schedule(path), _checkpoints(out)
    on = int(late.stem[6:])
    assert before.ended == max(whole) > on
    more = "--iterations", on + 20, "--checkpoint_iterations", on + 10, "--start_checkpoint"
    _train(colmap_scene, out, *more, late)
    assert f"this run has neither and continues at iteration {on} of --iterations" in capsys.readouterr().err
    assert not path.exists()
    steady = out / f"chkpnt{on + 10}.pth"
    _train(colmap_scene, out, *more, steady)
    assert "--time_budget" not in capsys.readouterr().err
    _train(colmap_scene, out, "--iterations", on + 60, "--time_budget", 5, "--start_checkpoint", steady)
    assert f"was trained without --time_budget; it is iteration {on + 10} of" in capsys.readouterr().err
    assert read_schedule(path).blocks[0].last == on + 10
    _train(colmap_scene, out, "--iterations", 20)
    assert not path.exists()


def test_a_time_budget_takes_the_strategy_that_is_best_in_it(colmap_scene, tmp_path, monkeypatch, capsys):
    _timed(monkeypatch, lambda t: 0.1)
    words = "--time_budget", 6, "--checkpoint_iterations", 1800
    first = _train(colmap_scene, tmp_path / "a", *words)
    out = capsys.readouterr().out
    assert out.count("--time_budget chose --strategy budget; give --strategy to use another one") == 1
    assert _stored(tmp_path / "a", "strategy") == read_schedule(tmp_path / "a" / "schedule.json").strategy == "budget"
    repeated = _train(colmap_scene, tmp_path / "b", "--schedule", tmp_path / "a" / "schedule.json")
    assert list(repeated.values()) == [first[max(first)]]
    checkpoint, _ = _checkpoints(tmp_path / "a")
    _train(colmap_scene, tmp_path / "c", *words, "--start_checkpoint", checkpoint)
    assert _stored(tmp_path / "b", "strategy") == _stored(tmp_path / "c", "strategy") == "budget"
    _train(colmap_scene, tmp_path / "d", "--iterations", 2)
    _train(colmap_scene, tmp_path / "e", "--iterations", 2, "--strategy", "mcmc")
    start = "--start_checkpoint", tmp_path / "e" / "chkpnt2.pth"
    _train(colmap_scene, tmp_path / "f", "--iterations", 3, *start)
    assert [_stored(tmp_path / name, "strategy") for name in "df"] == ["adc", "mcmc"]


@pytest.mark.parametrize(
    ("views", "seconds", "device", "strategy"),
    [(43, 10, "cpu", "budget"), (43, 10, "cuda", "budget"), (43, 11, "cuda", "mcmc"), (60, 90, "cuda", "budget")],
)
def test_few_photos_and_much_time_on_a_gpu_take_mcmc(views, seconds, device, strategy):
    scene = SimpleNamespace(getTrainCameras=lambda: [None] * views)
    run = SimpleNamespace(scene=scene, device=torch.device(device), parts=[])
    schedule = TimeBudget(Decided(30_000, [], None, seconds))
    assert schedule.best_strategy(run, strategies()) == strategy


@pytest.mark.parametrize("strategy", ["adc", "mcmc"])
def test_no_strategy_grows_beyond_what_the_clock_can_train(colmap_scene, tmp_path, monkeypatch, strategy):
    """Some 60 iterations train 1,500 Gaussians; without the clock there are more."""
    _timed(monkeypatch, lambda t: 0.1)
    words = "--strategy", strategy, "--densify_grad_threshold", 1e-7, "--mcmc_growth", 0.1
    by_clock = _train(colmap_scene, tmp_path / "a", *words, "--time_budget", 6)
    without = _train(colmap_scene, tmp_path / "b", *words, "--iterations", 60, "--densification_interval", 2,
                     "--densify_from_iter", 2, "--max_num_splats", 3000)  # fmt: skip
    counts = [int(re.search(rb"element vertex (\d+)", plies[max(plies)])[1]) for plies in (by_clock, without)]
    assert 300 < counts[0] <= 25 * 75 < counts[1]


@pytest.mark.parametrize("sizes", ["none", "pyramid"])
def test_the_clock_ends_growth_at_the_pace_of_whole_views_and_removes_nothing(sizes, capsys):
    """Growth to 25 Gaussians for each iteration, of which each takes the longer, and a quarter of it in half the size.

    A program that slows all down late in the run leaves the Gaussians there.
    """
    schedule = TimeBudget(Decided(30_000, [], None, 20.0, "auto"))
    schedule.megapixels = 100.0 if sizes == "pyramid" else 1e-3
    counts = [14_000]

    def cost(iteration: int, step: int) -> float:
        if step // 1000 > schedule.schedule_step(iteration - 1) // 1000 and step < 15_000:
            most = schedule.count_limit(iteration, counts[-1], 50_000, 50_000)
            counts.append(max(counts[-1], min(int(1.05 * counts[-1]) + 1, most)))
            assert schedule.count_limit(iteration, counts[-1], 50_000, 50_000) >= counts[-1]
        pixels = Sizes(schedule, None).factor_at(step) ** -2
        return (0.005 + counts[-1] * 1e-6) * (0.2 + 0.8 * pixels) * (3 if step > 13_000 else 1)

    _run(schedule, cost)
    assert schedule.sizes == sizes and schedule.count_limit(10, 9, 7, 50_000) == 7
    fits = 25 * 20.0 / (0.005 + counts[-1] * 1e-6)  # at the pace of whole views with so many
    assert counts[-1] == pytest.approx(fits, rel=0.12)
    (said,) = capsys.readouterr().err.splitlines()
    assert re.fullmatch(
        "In 20 s this machine takes about [0-9,]+ steps, enough for [0-9,]+ Gaussians, not for 50,000", said
    )


def test_a_strategy_of_a_damaged_file_is_none():
    """model.json of a resumed run, whose words nobody has checked."""
    with pytest.raises(UserError, match="^there is no strategy 'error_scores'; give --strategy adc or mcmc or budget$"):
        strategy_part("error_scores")


def test_a_number_of_iterations_goes_through_the_whole_schedule(tmp_path):
    """In equal parts, and with no limit of Gaussians, as no clock sets their number."""
    opt = options(schedule="1000", strategy="budget", iterations=30_000)
    schedule = schedule_of(opt, None, 0)
    steps = [schedule.schedule_step(t) for t in range(1001)]
    assert steps[::500] == [0, 15_000, 30_000] and schedule.is_last(1000)
    assert schedule.count_limit(100, 10, 90_000, 0) == 90_000
    write_schedule(tmp_path / "schedule.json", schedule.up_to(1000))
    assert read_schedule(tmp_path / "schedule.json").blocks == schedule.blocks
    for words, reason in (
        ({"schedule": "0"}, "between 1 and 2147483647"),
        ({"time_budget": 9.0}, "leave one of them out"),
    ):
        with pytest.raises(UserError, match=reason):
            schedule_of(options(**{"schedule": "7"} | words), None, 0)


@pytest.mark.parametrize("name", ["constant", "growth"])
def test_half_of_the_schedule_is_done_in_half_of_the_seconds(name):
    schedule, begun = _fresh(30_000, 20.0), []

    def cost(iteration: int, step: int) -> float:
        begun.append((step, (begun[-1][1] + COSTS[name](iteration - 1, begun[-1][0])) if begun else 0.0))
        return COSTS[name](iteration, step)

    _run(schedule, cost)
    assert next(seconds for step, seconds in begun if step >= 15_000) == pytest.approx(10.0, abs=0.7)


def test_the_end_of_a_repeated_schedule_is_known():
    repeated = DecidedSchedule(Decided(100, [Block(20, 0.0, 0.05, 0.0)], 20, 9.0))
    assert repeated.known([50, 100]) == [20] and repeated.known([50]) == [] == _fresh(100, 9.0).known([50, 100])


@pytest.mark.parametrize("length", [30_000, 7000])
@pytest.mark.parametrize(
    ("steps", "factor"),
    [(3000, math.sqrt(40)), (7000, 2 * math.sqrt(30 / 7)), (15_000, math.sqrt(8)), (30_000, 2.0), (240_000, 1.0)],
)
def test_rates_fall_to_a_tenth_at_the_end(length, steps, factor):
    """Whatever --iterations counts: the rates of a run follow the number of its own."""
    schedule = DecidedSchedule(_evenly(length, steps))
    percents = range(steps // 100, steps + 1, steps // 100)
    factors = [schedule.rate_factor(iteration) for iteration in percents]
    held = int(0.7 * len(factors))
    assert factors[:held] == pytest.approx([factor] * held) and factors[-1] == pytest.approx(0.1 * factor)
    falling = factors[held:]
    assert falling == sorted(falling, reverse=True) and falling[0] > 0.98 * factor
    assert schedule.rate_factor(int(0.85 * steps)) == pytest.approx(0.55 * factor, abs=0.01 * factor)
    assert factors == pytest.approx([stride_rate_factor(30_000 / steps, iteration / steps) for iteration in percents])


@pytest.mark.parametrize(
    ("device", "photos", "wanted"), [("cuda", 20, 25), ("cuda", 75, 37.5), ("cuda", 300, 50), ("cpu", 300, 25)]
)
def test_many_photos_on_a_gpu_train_more_gaussians(device, photos, wanted):
    info = SimpleNamespace(has_random_points=False)
    scene = SimpleNamespace(
        getTrainCameras=lambda: [None] * photos, training_pixels=lambda: (1e6, 1), images=None, info=info
    )
    run = SimpleNamespace(scene=scene, device=torch.device(device), schedule=_fresh(3000, 20.0))
    time_budget.TimeBudget().begin(run, None)
    assert run.schedule.an_iteration == wanted
