"""Runs as report.json lists them, made up."""

from applications.evaluation.comparison import QUANTITIES
from splatting.records.error_curve import COLUMNS


def curve(*points: tuple[float, float | None, float]) -> list[dict]:
    """Rows of (seconds, test PSNR, Gaussians)."""
    return [
        dict.fromkeys(COLUMNS) | {"iteration": 10 * i, "seconds": s, "test_psnr": p, "gaussians": n}
        for i, (s, p, n) in enumerate(points, 1)
    ]


def run_of(config: str | None, seed: int, *points: tuple[float, float, int], scene: str = "attic", **more) -> dict:
    """A finished run of a scene with a curve, saved at 100 bytes a Gaussian."""
    end, (seconds, psnr, gaussians) = 10 * len(points), points[-1]
    values = dict.fromkeys(QUANTITIES) | {
        "PSNR": psnr, "seconds": seconds, "gaussians": gaussians, "gaussians_saved": gaussians,
        "ply_mb": gaussians / 1e4, "views": 2,
    }  # fmt: skip
    return {
        "added_options": [], "apart": False, "config": config, "conventions": {}, "cpu_seconds": None,
        "curve": curve(*points), "failure": None, "final_iteration": end, "finished": True, "group": "scenes",
        "ground_truth_sha256": "a" * 64, "iterations": {str(end): values}, "lines": [], "machine": {},
        "model": f"{scene}/{config}/{seed}", "open_ended": False, "options": [], "page": None, "peak": None,
        "photos": None, "poses": [], "scene": scene, "seed": seed, "source": None, "split": None,
        "test_sizes": [[96, 64]],
        "views": {"test": 2, "train": 7}, "wall_seconds": None, "worst_views": [],
    } | more  # fmt: skip


def set_runs(scene: str = "attic") -> list[dict]:
    """Three sets of two seeds: `fast` gets there in half the seconds, `small` in none, but it has few Gaussians."""
    return [
        *(
            run_of("adc", i, (10, 20.0, 100), (20, 30.0, 200), (40, end, 300), scene=scene)
            for i, end in enumerate((31.0, 31.4))
        ),
        *(
            run_of("fast", i, (5, 20.0, 100), (10, 30.0, 400), (20, end, 500), scene=scene)
            for i, end in enumerate((32.2, 32.2))
        ),
        *(
            run_of("small", i, (10, 20.0, 50), (30, 29.0, 60), (50, end, 70), scene=scene)
            for i, end in enumerate((30.0, 30.8))
        ),
    ]
