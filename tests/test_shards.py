"""Models whose rows are divided among ranks: the files of one process, after any change of rows."""

import math
import zipfile
import zlib
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from gaussians import cloud, options
from processes import in_ranks
from strategies import begun
from torch import Tensor

from groundwork.ranks.ranks import ranks
from scene.gaussian_model import GaussianModel
from scene.gaussians.checkpoint import load_checkpoint, save_checkpoint
from scene.gaussians.density_rules import logit
from scene.gaussians.sh_bands import cut_bounds
from utils.system_utils import UserError

EXTENT, THRESHOLD = 2.0, 2e-4
ITERATIONS = (599, 600, 650, 700, 2999, 3000, 3001, 3100, 3101)  # opacities are reset in 3000, sizes limited in 3100


class Client(GaussianModel):
    """A model that has replaced a step of density control."""

    def densify_and_clone(self, *args: object) -> None:
        super().densify_and_clone(*args)


def _start(count: int, kind: type[GaussianModel] = GaussianModel, **changes: object) -> GaussianModel:
    """A model with random parameters, of which every rank has a part."""
    gaussians = kind(1, str(changes.get("optimizer_type", "default")))
    gaussians.divide(ranks())
    gaussians.create_from_pcd(cloud(count), [], EXTENT)
    with torch.no_grad():
        for name, spread in {"f_dc": 1, "f_rest": 1, "opacity": 2.5, "rotation": 1, "scaling": 1.5}.items():
            gaussians.raw(name).add_(spread * _random(gaussians, name, *gaussians.raw(name).shape[1:]))
    gaussians.training_setup(options(**changes))
    return gaussians


def _random(gaussians: GaussianModel, what: str, *shape: int) -> Tensor:
    """Random numbers (n, *shape) of this rank's Gaussians, the same for any number of ranks."""
    generator = torch.Generator().manual_seed(zlib.crc32(what.encode()))
    every = torch.randn(gaussians.gaussian_count, *shape, generator=generator)
    return every[gaussians.shards.first :][: len(gaussians)]


def _train(gaussians: GaussianModel, density: object, iterations: tuple[int, ...] = ITERATIONS) -> None:
    """Iterations with random gradients. A rank without Gaussians takes no steps, as the fused step does."""
    for iteration in iterations:
        gaussians.update_learning_rate(iteration)
        for name in gaussians._attributes if len(gaussians) else ():
            param = gaussians.raw(name)
            param.grad = _random(gaussians, f"{name}{iteration}", *param.shape[1:])
        if any(density.penalty):
            gaussians.add_penalty_gradients(density.penalty)
        points = torch.zeros(len(gaussians), 3)
        points.grad = THRESHOLD * (2 * _random(gaussians, f"seen{iteration}", 3)).round()  # several are the same
        radii = (20 * _random(gaussians, f"radii{iteration}").abs()).int()
        step = SimpleNamespace(iteration=iteration, background=None, density=density.actions(iteration))
        density.after_backward(step, {"viewspace_points": points, "radii": radii})
        if len(gaussians):
            gaussians.step(radii)
        density.after_step(step)


def _adc(gaussians: GaussianModel, *further: int, **changes: object) -> None:
    _train(gaussians, begun("adc", gaussians, options(**changes), extent=EXTENT), further or ITERATIONS)


def _limited(gaussians: GaussianModel) -> None:
    _adc(gaussians, max_num_splats=gaussians.gaussian_count + 7)
    _adc(gaussians, 900, max_num_splats=gaussians.gaussian_count + 5, absgrad=True)


def _by_hand(gaussians: GaussianModel) -> None:
    """Steps one by one, with radii and a seed of torch's, and statistics that stay."""
    _adc(gaussians, 549, 550)
    gaussians.prune_points(_random(gaussians, "pruned") < -1)
    gaussians.tmp_radii = gaussians.shards.global_indices(torch.arange(len(gaussians)))
    torch.manual_seed(5)
    gaussians.densify_and_split(_random(gaussians, "split", 1).abs(), 0.5, EXTENT, N=3)
    gaussians.prune_points(_random(gaussians, "again") < -1)
    gaussians.max_radii2D = gaussians.tmp_radii.float()
    gaussians.prune_points(torch.zeros(len(gaussians), dtype=torch.bool))


def _emptied(gaussians: GaussianModel) -> None:
    """All rows of the first ranks are removed, then some rows are added, then nothing is."""
    _adc(gaussians, 549, 550)
    with torch.no_grad():
        first = gaussians.shards.global_indices(torch.arange(len(gaussians))) < 0.8 * gaussians.gaussian_count
        gaussians.raw("opacity")[first] = -9.0
    _adc(gaussians, 600, 601)
    _adc(gaussians, 700, densify_grad_threshold=1e6)


def _mcmc(gaussians: GaussianModel, **changes: object) -> None:
    changes = {"mcmc_min_opacity": 0.02, "mcmc_noise": 1e4, "mcmc_growth": 0.2} | changes
    starts = "max_num_splats" not in changes
    density = begun("mcmc", gaussians, options(strategy="mcmc", **changes), starts=starts)
    _train(gaussians, density, (501, 600, 700))
    with torch.no_grad():
        gaussians.raw("opacity").copy_(3 * _random(gaussians, "opacity", 1))
    _train(gaussians, density, (800, 900, 901))


def _mcmc_at_one_end(gaussians: GaussianModel) -> None:
    """Only the last Gaussian lives."""
    with torch.no_grad():
        last = gaussians.shards.global_indices(torch.arange(len(gaussians))) == gaussians.gaussian_count - 1
        gaussians.raw("opacity")[:, 0] = torch.where(last, 2.0, -5.0)
    _mcmc(gaussians, max_num_splats=gaussians.gaussian_count + 30, mcmc_min_opacity=0.01)


def _budget(gaussians: GaussianModel) -> None:
    opt = options(strategy="budget", max_num_splats=2 * gaussians.gaussian_count, opacity_decay=0.9, prune_opacity=0.05)
    density = begun("budget", gaussians, opt)
    scores = "scores"
    density._scores = lambda *_: _random(gaussians, scores).double().clamp_min(0.0)
    _train(gaussians, density)
    density.max_gaussians = gaussians.gaussian_count - 10
    _train(gaussians, density, (14900,))
    with torch.no_grad():
        gaussians.raw("opacity")[_random(gaussians, "same") > 0] = logit(0.5)
    density.max_gaussians = gaussians.gaussian_count - 40
    _train(gaussians, density, (14900,))


Scenario = tuple[int, type[GaussianModel], Callable[[GaussianModel], None], dict[str, object]]
SCENARIOS: dict[str, Scenario] = {
    "adc": (900, GaussianModel, _adc, {}),
    "sparse": (480, GaussianModel, _adc, {"optimizer_type": "sparse_adam"}),
    "limited": (900, GaussianModel, _limited, {}),
    "few": (2, GaussianModel, _adc, {}),
    "one": (1, GaussianModel, _adc, {}),
    "by hand": (540, GaussianModel, _by_hand, {}),
    "client": (420, Client, _adc, {}),
    "emptied": (360, GaussianModel, _emptied, {}),
    "mcmc": (720, GaussianModel, _mcmc, {}),
    "mcmc, few": (2, GaussianModel, _mcmc, {}),
    "mcmc, one end": (20, GaussianModel, _mcmc_at_one_end, {}),
    "budget": (780, GaussianModel, _budget, {}),
    "budget, few": (2, GaussianModel, _budget, {}),
}
RESUMED = ("adc", "few", "mcmc")  # from the files of one process, and trained further


def _told(gaussians: GaussianModel) -> list[object]:
    """Return the facts and the error of a whole model, some of whose values are then broken."""
    told: list[object] = [cut_bounds(gaussians.raw("f_rest").detach(), gaussians.shards), gaussians.size_as_ply]
    with torch.no_grad():
        some = _random(gaussians, "broken") > 1
        gaussians.raw("scaling")[some] = math.nan
    with pytest.raises(UserError) as error:
        gaussians.check_finite(7)
    return [*told, str(error.value)]


def _run(folder: Path, start: Path) -> tuple[dict[str, tuple[int, int, int]], list[object]]:
    """Write checkpoints and PLYs after each scenario, and after resuming some of one process."""
    shapes = {}
    for name, (count, kind, change, changes) in SCENARIOS.items():
        gaussians = _start(count, kind, **changes)
        change(gaussians)
        shapes[name] = _save(gaussians, folder / name)
    for name in RESUMED:
        gaussians = GaussianModel(1)
        gaussians.divide(ranks())
        gaussians.restore(load_checkpoint(start / name / "chkpnt7.pth")[0], options())
        _save(gaussians, folder / f"{name}, resumed")
        _adc(gaussians, 899, 900, 901)
        shapes[f"{name}, further"] = _save(gaussians, folder / f"{name}, further")
        told = _told(gaussians)
        gaussians.load_ply(start / name / "point_cloud.ply")
        gaussians.part(_random(gaussians, "part") < 0.5, 0).save_ply(folder / f"{name}, resumed" / "part.ply")
    return shapes, told


def _save(gaussians: GaussianModel, folder: Path) -> tuple[int, int, int]:
    folder.mkdir(exist_ok=True, parents=True)
    save_checkpoint(folder / "chkpnt7.pth", gaussians.capture(), 7)
    gaussians.save_ply(folder / "point_cloud.ply")
    return gaussians.shards.first, len(gaussians), gaussians.gaussian_count


def _content(folder: Path) -> list[tuple[str, bytes]]:
    """The PLYs and the parts of the checkpoint, whose names in the archive begin with that of a temporary file."""
    with zipfile.ZipFile(folder / "chkpnt7.pth") as archive:
        parts = [(part.partition("/")[2], archive.read(part)) for part in archive.namelist()]
    return [*((path.name, path.read_bytes()) for path in sorted(folder.glob("*.ply"))), *parts]


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    folder = tmp_path_factory.mktemp("alone")
    return folder, _run(folder, folder)


def test_ranks_together_write_the_files_of_one_process(alone, tmp_path):
    size, (folder, (shapes, told)) = 3, alone
    every, others = zip(*in_ranks(size, _run, tmp_path, folder), strict=True)
    assert others == (told,) * size
    for name, (_, _, total) in shapes.items():
        bounds = [min(-(-total // 128) * rank // size * 128, total) for rank in range(size + 1)]
        assert [rank[name] for rank in every] == [(a, b - a, total) for a, b in pairwise(bounds)], name
    for there in sorted(folder.iterdir()):
        found, wanted = _content(tmp_path / there.name), _content(there)
        assert [name for name, _ in found] == [name for name, _ in wanted], there.name
        assert [a for a, b in zip(found, wanted, strict=True) if a != b] == [], there.name


def test_the_scenarios_change_rows(alone):
    """Each in another way, so that none is in vain."""
    _, (shapes, _) = alone
    totals = {name: total for name, (_, _, total) in shapes.items()}
    assert all(total > 0 for total in totals.values()), totals
    assert all(totals[name] != count for name, (count, *_) in SCENARIOS.items() if name != "one"), totals
