"""A training by gaussian-splatting of PyPI (a fork of the reference, for research alone), for a curve beside ours.

    python -m benchmarks.peers.gaussian_splatting_training -s SCENE -m OUT --eval [--seed N]
    python -m benchmarks.peers.curve -m OUT

It has the reference's kernels, and defaults of its own. It reads COLMAP scenes of pinholes itself: here a copy without
the test photos, in their own size, whatever -r says. What its own loop prints is left out, which only helps. Writes
what `benchmarks.peers.timed` says.
"""

import argparse
import tempfile
from pathlib import Path

from arguments import ModelParams
from benchmarks.harness.colmap_part import but_every, part
from benchmarks.peers.timed import DEGREE, shuffled, train
from scene.readers.info import HOLD
from scene.scene import Scene
from utils.system_utils import UserError, compute_device, run_cli


class Training:
    """The package's own trainer of its own model on its own cameras."""

    def __init__(self, source: Path, seed: int) -> None:
        try:
            from gaussian_splatting.train import prepare_training
        except ImportError as error:
            raise UserError(f"{error}; run pip install gaussian-splatting==2.11.0 (Python 3.10 or 3.11)") from error
        cameras, self._gaussians, self._trainer = prepare_training(
            DEGREE, str(source), str(compute_device()), "densify", load_mask=False, load_depth=False
        )
        self._views = shuffled([cameras[place] for place in range(len(cameras))], seed)

    def __len__(self) -> int:
        return len(self._gaussians.get_xyz)

    def step(self, step: int) -> None:
        """An iteration."""
        self._trainer.step(next(self._views))

    def save(self, path: Path) -> None:
        """Write a PLY."""
        self._gaussians.save_ply(str(path))


def start(scene: Scene, options: ModelParams, args: argparse.Namespace) -> Training:
    """The training of a scene's training views."""
    if options.white_background or not (Path(options.source_path) / "sparse").is_dir():
        raise UserError("gaussian-splatting reads COLMAP scenes with a black background alone; give such a scene")
    with tempfile.TemporaryDirectory() as folder:
        return Training(part(Path(options.source_path), Path(folder), lambda views: but_every(HOLD, views)), args.seed)


if __name__ == "__main__":
    run_cli(lambda: train(argparse.ArgumentParser(description=__doc__.splitlines()[0]), start))
