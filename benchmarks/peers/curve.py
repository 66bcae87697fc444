"""Score another program's sequence of PLYs as train.py scores its own, into a CSV for `full_eval.py --peer`.

    python -m benchmarks.peers.curve -m MODEL [-s SCENE] [-w]

MODEL/seconds.csv has the columns iteration and seconds, of training alone. The models are the PLYs of
MODEL/point_cloud/iteration_N, in the world of the dataset. Views are the test views of SCENE, which MODEL/cfg_args may
name. Writes MODEL/peer.csv.
"""

from pathlib import Path

import torch
from tqdm import tqdm

from arguments import ModelParams, OptionParser, PipelineParams, get_combined_args
from gaussian_renderer.scored_views import ScoredViews
from scene.saved_model import load_saved, read_model
from splatting.records.error_curve import read_peer, write_peer
from utils.system_utils import UserError, compute_device, run_cli, saved_ply

SECONDS, CURVE = "seconds.csv", "peer.csv"


def main() -> None:
    """Score the PLYs of a folder on the test views, and write the curve."""
    parser = OptionParser(description=__doc__.splitlines()[0])
    model_params, pipeline_params = ModelParams(parser, sentinel=True), PipelineParams(parser, sentinel=True)
    parser.set_defaults(ply=SECONDS)  # a folder of another program need not have cfg_args
    args = get_combined_args(parser)
    options, pipe = model_params.extract(args), pipeline_params.extract(args)
    options.eval, options.other_scene, model = True, "", Path(args.model_path)
    rows = read_peer(model / SECONDS, ("iteration", "seconds"))
    scene = load_saved(options, int(rows[0]["iteration"]))
    if not (views := scene.getTestCameras()):
        raise UserError(f"{options.source_path} has no test views; name a scene that has some")
    background = torch.full((3,), float(options.white_background), device=compute_device())
    scored = ScoredViews(pipe, background, False)
    for row in tqdm(rows, desc="Scoring", unit="model"):
        gaussians = read_model(saved_ply(model, int(row["iteration"])))
        found = scored.scores(views, gaussians)
        row |= {"gaussians": len(gaussians)} | {f"test_{name}": value for name, value in found.items()}
    write_peer(model / CURVE, rows)
    print(f"wrote {len(rows)} points to {model / CURVE}")


if __name__ == "__main__":
    run_cli(main)
