"""A training by gsplat (Apache 2.0) through its public functions, for a curve beside ours.

    python -m benchmarks.peers.gsplat_training -s SCENE -m OUT --eval [-w] [--strategy mcmc] [--seed N]
    python -m benchmarks.peers.curve -m OUT

Photos, poses, points and split are those of train.py, and lie in memory before the clock starts. Rates, schedules and
weights are the defaults of gsplat's own trainer, in a frame like its own. The loss is our fused kernel and Adam is
torch's fused one, which only helps. Writes what `benchmarks.peers.timed` says.
"""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from arguments import ModelParams
from benchmarks.peers.timed import DEGREE, shuffle_forever, train
from scene.cameras import Camera
from scene.gaussians.ply import write_ply
from scene.gaussians.start import start_rows
from scene.scene import Scene
from utils.graphics_utils import camera_center, world_to_camera
from utils.loss_utils import photometric_loss
from utils.system_utils import UserError, compute_device, run_cli

RATES = {"means": 1.6e-4, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 2.5e-3 / 20}
LAST_RATE = 0.01  # of the means' rate, which falls to this part of its start exponentially
DEGREE_EVERY = 1000  # iterations until the next band of SH
DSSIM = 0.2
# Of 3DGS-MCMC (Kheradmand et al. 2024): the start, and weights of the mean opacity and of the mean scale in the loss.
MCMC_OPACITY, MCMC_SIZE, MCMC_WEIGHT = 0.5, 0.1, 0.01


class Frame(NamedTuple):
    """A frame of which the world's point `center` (3,) is the origin, and `scale` times a world's length the length."""

    center: np.ndarray
    scale: float


class View(NamedTuple):
    """A training view as gsplat takes it, and what its render should equal."""

    viewmats: Tensor  # (1, 4, 4)
    Ks: Tensor  # (1, 3, 3)
    width: int
    height: int
    target: Tensor
    mask: Tensor | None


def find_frame(cameras: Sequence[Camera]) -> Frame:
    """The frame that gsplat's defaults are made for, up to a rotation.

    The origin is the point nearest to all optical axes, and the median distance of a camera to it is 1.
    """
    centers = np.stack([camera_center(camera.R, camera.T) for camera in cameras])
    axes = np.stack([camera.R[:, 2] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    center = np.linalg.lstsq(across.sum(0), np.einsum("nij,nj->i", across, centers), rcond=None)[0]
    return Frame(center, 1 / float(np.median(np.linalg.norm(centers - center, axis=1))))


def make_view(camera: Camera, frame: Frame, background: Tensor) -> View:
    """The view of a camera in a frame."""
    matrix = world_to_camera(camera.R, camera.T, -frame.center, frame.scale)
    K = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    both = [
        torch.tensor(np.array(values)[None], dtype=torch.float32, device=background.device) for values in (matrix, K)
    ]
    return View(*both, camera.image_width, camera.image_height, *camera.ground_truth(background))


class Training:
    """Parameters, optimisers and strategy, and how far they have come."""

    def __init__(self, scene: Scene, options: ModelParams, args: argparse.Namespace) -> None:
        """Start gsplat's parameters, optimisers and strategy, and render once to compile what is missing."""
        try:
            import gsplat
        except ImportError as error:
            raise UserError(f"{error}; run pip install gsplat==1.5.3") from error
        self._draw, self._mcmc, self._iterations = gsplat.rasterization, args.strategy == "mcmc", args.iterations
        self.frame, device = find_frame(scene.getTrainCameras()), compute_device()
        self._shift = torch.from_numpy(self.frame.center + scene.info.offset)  # the frame's origin in the world
        self.background = torch.full((3,), float(options.white_background), device=device)
        self._views = shuffle_forever(
            [make_view(of, self.frame, self.background) for of in scene.getTrainCameras()], args.seed
        )
        self._extent = scene.cameras_extent * self.frame.scale
        self.params = torch.nn.ParameterDict(self._make_parameters(scene)).to(device)
        self._optimizers = {
            name: torch.optim.Adam(
                [self.params[name]], rate * (self._extent if name == "means" else 1), eps=1e-15, fused=True
            )
            for name, rate in RATES.items()
        }
        if self._mcmc:
            self._strategy = gsplat.MCMCStrategy(cap_max=args.cap_max)
            self._state = self._strategy.initialize_state()
        else:
            self._strategy = gsplat.DefaultStrategy()
            self._state = self._strategy.initialize_state(scene_scale=self._extent)
        self._strategy.check_sanity(self.params, self._optimizers)
        self.render(next(self._views), 0)  # compiles what is missing

    def _make_parameters(self, scene: Scene) -> dict[str, torch.nn.Parameter]:
        """Return the first parameters by gsplat's names, in the frame of `find_frame`."""
        rows = start_rows(scene.info.point_cloud, scene.cameras_extent, DEGREE)
        values = {
            "means": ((rows["xyz"] - torch.from_numpy(self.frame.center)) * self.frame.scale).float(),
            "scales": rows["scaling"] + math.log(self.frame.scale * (MCMC_SIZE if self._mcmc else 1)),
            "quats": rows["rotation"],
            "opacities": rows["opacity"][:, 0],
            "sh0": rows["f_dc"],
            "shN": rows["f_rest"],
        }
        if self._mcmc:
            values["opacities"] = torch.full_like(values["opacities"], MCMC_OPACITY).logit()
        return {name: torch.nn.Parameter(value.contiguous()) for name, value in values.items()}

    def __len__(self) -> int:
        return len(self.params["means"])

    def render(self, view: View, step: int) -> tuple[Tensor, dict[str, Any]]:
        """The image (3, H, W) of a view, and gsplat's notes for its strategy."""
        p = self.params
        image, _, info = self._draw(
            p["means"], p["quats"], p["scales"].exp(), p["opacities"].sigmoid(), torch.cat([p["sh0"], p["shN"]], 1),
            view.viewmats, view.Ks, view.width, view.height, sh_degree=min(step // DEGREE_EVERY, DEGREE), packed=False,
            backgrounds=self.background[None],
        )  # fmt: skip
        return image[0].permute(2, 0, 1).contiguous(), info

    def step(self, step: int) -> None:
        """An iteration; the first one is 0."""
        view = next(self._views)
        image, info = self.render(view, step)
        both = self.params, self._optimizers, self._state, step, info
        self._strategy.step_pre_backward(*both)
        loss = photometric_loss(image, view.target, DSSIM, view.mask, clamp=False)[0]
        if self._mcmc:
            loss = loss + MCMC_WEIGHT * (self.params["opacities"].sigmoid().mean() + self.params["scales"].exp().mean())
        loss.backward()
        rate = RATES["means"] * self._extent * LAST_RATE ** (step / self._iterations)
        self._optimizers["means"].param_groups[0]["lr"] = rate
        for optimizer in self._optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        self._strategy.step_post_backward(*both, **({"lr": rate} if self._mcmc else {"packed": False}))

    def save(self, path: Path) -> None:
        """Write a PLY in the world."""
        p = {name: value.detach() for name, value in self.params.items()}
        xyz = p["means"].double() / self.frame.scale + self._shift.to(p["means"].device)
        rows = {"xyz": xyz, "f_dc": p["sh0"], "f_rest": p["shN"]}
        rows |= {"opacity": p["opacities"][:, None], "rotation": p["quats"]}
        write_ply(path, rows | {"scaling": p["scales"] - math.log(self.frame.scale)}, DEGREE)


def main() -> None:
    """Train by gsplat as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--strategy", choices=("default", "mcmc"), default="default", help="gsplat's (default: default)"
    )
    parser.add_argument(
        "--cap_max", type=int, default=1_000_000, help="most Gaussians of mcmc (default: gsplat's, 1000000)"
    )
    train(parser, Training)


if __name__ == "__main__":
    run_cli(main)
