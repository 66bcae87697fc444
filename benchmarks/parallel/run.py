"""A training of a workload by the ranks of this process, by the code of train.py, without a scene folder."""

from types import SimpleNamespace

import torch

from benchmarks.parallel.workload import Workload
from groundwork.ranks.ranks import ranks
from scene.gaussian_model import GaussianModel
from scene.gaussians.morton import sort_rows
from scene.in_view import share_in_view
from scene.sleeping import Sleeping
from splatting.commands import train
from splatting.iteration import ViewOrder
from splatting.objective import Objective
from splatting.records.training_log import Stopwatch
from splatting.registry import strategy_part
from splatting.run import Run
from splatting.schedule import Schedule
from splatting.spill import make_storage, sentences
from splatting.watch import DivergenceWatch
from utils.system_utils import compute_device

_EXTENT = 5.0  # world units
_STILL = ("--position_lr_init", "0", "--position_lr_final", "0", "--feature_lr", "0", "--opacity_lr", "0",
          "--scaling_lr", "0", "--rotation_lr", "0")  # fmt: skip


class WorkloadRun(Run):
    """A run whose scene is a workload. Gaussians are observed, and none is added or removed.

    steps: how many it takes; in the last one the optimisers rest. still: with learning rates of 0, which have the
    arithmetic of a step but leave the scene as it is, so that every step does the same work. sleep: let blocks sleep,
    with rows in order. gpu_memory: as the option.
    """

    def __init__(self, workload: Workload, steps: int, still: bool, sleep: bool = False, gpu_memory: float = 0) -> None:
        """Make the run as train.py does, with a scene that has cameras and nothing else."""
        group, device, gaussians = ranks(), compute_device(), GaussianModel(3)
        words = ["-s", ".", "--iterations", str(steps), "--densify_from_iter", "10000", *_STILL * still]
        words += ["--strategy", "adc", *(["--gpu_memory", str(gpu_memory)] if gpu_memory else [])]
        launch, dataset, opt, pipe = train.parse(words)
        self._cameras = cameras = workload.cameras()
        images = SimpleNamespace(ahead=0, keep_on=torch.device("cpu"), planned_bytes=0)
        info = SimpleNamespace(point_cloud=None)
        scene = SimpleNamespace(
            cameras_extent=_EXTENT, images=images, prefetch=lambda _: None, model_path=".", info=info
        )
        scene.getTrainCameras = lambda: cameras
        if gpu_memory:
            gaussians.storage = make_storage(gaussians, opt, device, absolute=False)
            gaussians.storage.limit_for(-(-workload.gaussians // group.size), scene)
        made = Schedule(opt.iterations), scene, gaussians, ViewOrder(cameras, opt.seed)
        super().__init__(dataset, opt, pipe, launch, group, device, None, 0, [], *made)
        self._begin_model(workload)
        self.objective = Objective(self)
        self.log, self.rows = SimpleNamespace(seconds_before=0.0), []
        self.watch = DivergenceWatch(self)
        self.strategy = strategy_part("adc")
        self.strategy.begin(self, None)
        self.parts = [self.strategy]
        if sleep:
            sort_rows(gaussians)
            self.sleeping = Sleeping(gaussians)

    def _begin_model(self, workload: Workload) -> None:
        """Give the model this rank's rows of the workload, and an optimiser."""
        gaussians, here = self.gaussians, self.group
        gaussians.divide(here)
        keep = torch.device("cpu") if gaussians.storage else self.device
        gaussians.set_rows(workload.rows(here.rank, here.size, self.device, keep))
        gaussians.active_sh_degree, gaussians.spatial_lr_scale = 3, _EXTENT
        gaussians.start_exposures(())
        gaussians.training_setup(self.opt)
        gaussians.limit_columns()

    def open(self) -> None:
        """Say what is spilled, and start the clocks; nothing is written."""
        room = self.gaussians.storage
        if room and room.host_bytes(len(self.gaussians)):
            room.rebalance(self.gaussians)
            seen = share_in_view(self.gaussians.get_xyz.detach(), self._cameras)
            print("".join(f"{said}\n" for said in sentences(room, len(self.gaussians), seen, True)), end="")
        self.clock = Stopwatch()
