"""Cases of option sets: words of a command line, and whole trainings with options in and out of range."""

import argparse
import contextlib
import io
import json
import random
import shutil
from pathlib import Path

from synthetic import make_blender_scene

import train
from applications.evaluation.configs import read_configs
from arguments import ModelParams, OptimizationParams, PipelineParams, read_cfg_args, read_model_json
from arguments.launch import add_launch_options
from fuzz.damage import changed, damaged

_WORDS = (
    *("-1", "0", "1", "2", "3", "7", "0.5", "-0.1", "1e-9", "1e9", "nan", "inf", "-inf", "1e400", "9" * 30, "x", ""),
    *("cpu", "cuda", "cuda:99", "auto", "ignore", "transparent", "sparse_adam", "default", "\0", "..", "True"),
)
_LEFT_OUT = {"help", "source_path", "model_path", "iterations", "ip", "port", "quiet", "start_checkpoint"}
_TRAINED = 0.15  # share of the accepted option sets that are trained


class Options:
    """Option sets as words, as a file for full_eval.py, and as the records in a model folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder / "options"
        make_blender_scene(self._folder / "scene", views=2)
        with contextlib.redirect_stdout(io.StringIO()):
            train.main(self._words([]))
        out = (self._folder / "out").rename(self._folder / "records")
        self._records = {name: (out / name).read_bytes() for name in ("cfg_args", "model.json")}
        self._options = [action for action in _parser()._actions if action.dest not in _LEFT_OUT]

    def run(self, rng: random.Random) -> None:
        what = rng.choice(("words", "words", "words", "configs", "records"))
        if what == "words":
            self._run_words(rng)
        elif what == "configs":
            path = self._folder / "configs.json"
            content = {"fast": ["--optimizer_type", "sparse_adam"], "plain": [], "r": ["-r", "2"]}
            path.write_text(json.dumps(changed(rng, content)))
            if rng.random() < 0.3:
                path.write_bytes(damaged(rng, path.read_bytes()))
            read_configs(path, train.parse)
        else:
            name, whole = rng.choice(list(self._records.items()))
            (self._folder / "records" / name).write_bytes(damaged(rng, whole))
            (read_cfg_args if name == "cfg_args" else read_model_json)(self._folder / "records")

    def _run_words(self, rng: random.Random) -> None:
        words = []
        for action in rng.sample(self._options, rng.randint(1, 4)):
            words.append(action.option_strings[-1])
            if action.nargs != 0:
                words += [_value(rng, action) for _ in range(rng.randint(1, 3) if action.nargs == "+" else 1)]
        words = self._words(words)
        train.parse(words)
        if rng.random() < _TRAINED:
            shutil.rmtree(self._folder / "out", ignore_errors=True)
            train.main(words)

    def _words(self, more: list[str]) -> list[str]:
        places = ["-s", str(self._folder / "scene"), "-m", str(self._folder / "out")]
        return [*places, "--iterations", "3", "--quiet", *more]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser()
    for add in (ModelParams, OptimizationParams, PipelineParams, add_launch_options):
        add(parser)
    return parser


def _value(rng: random.Random, action: argparse.Action) -> str:
    if action.choices and rng.random() < 0.7:
        return str(rng.choice(list(action.choices)))
    if isinstance(action.default, int | float) and rng.random() < 0.6:
        return str(rng.choice((action.default, action.default * 2, action.default * 1000, -action.default, 0)))
    return rng.choice(_WORDS)
