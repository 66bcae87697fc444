"""Removal of what a model does not need, and lines about what that saves."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from gaussian_renderer.scored_views import ScoredViews
from gaussian_renderer.trimming import FEW, ITERATIONS_PER_VIEW, TOO_LONG, WORTH, change_on_views, trim
from scene.gaussian_model import GaussianModel
from scene.gaussians.sh_bands import needed_degree

if TYPE_CHECKING:
    from splatting.run import Run

MB = 1e6


@dataclass
class TrimReport:
    """Facts about a removal, for `lines` and model.json."""

    gaussians: int  # trained
    unseen: int  # of these, not saved, because nobody sees them
    faint: int  # of these, of an opacity below 1/255
    keep_unseen: bool
    search: str  # how the search for the others ended (trimming.py)
    views: int  # that it looked at, or would have
    iterations: int  # of the training
    max_sh_degree: int  # trained
    sh_degree: int  # saved
    cut_bounds: list[float]  # by degree: bound on a colour's change if all SH bands above the degree are cut
    ply_bytes: int  # of all Gaussians trained, with all bands
    ply_bytes_saved: int
    seconds: float  # that the search took
    picture_bytes: int  # of the training photos at training size: one byte per colour value
    picture_bytes_in_files: int  # the same at the size of the files
    test_change: dict[str, float] = field(default_factory=dict)  # `trimming.change_on_views`; {} without test views


def saved_line(it: TrimReport, folder: Path) -> str:
    """Return the line in which training says what was saved, where, and what the file lacks."""
    size = f"{(it.ply_bytes - it.ply_bytes_saved) / MB:.2f} MB"
    if it.sh_degree < it.max_sh_degree:
        size += f"; SH bands above degree {it.sh_degree} left out"
    elif (trained := needed_degree(it.cut_bounds, 0.0)) < it.sh_degree:
        above = f" above degree {trained}" if trained else ""
        share = 100 * _band_bytes(it, trained) / (it.ply_bytes - it.ply_bytes_saved)
        size += (
            f"; no SH band{above} was trained, and their zeros are {share:.0f} % of it: --prune_sh 0 leaves them out"
        )
    line = f"Saved {it.gaussians - it.unseen:,} Gaussians to {folder} ({size})"
    if not it.unseen:
        return line
    why = "(opacity below 1/255)" if it.unseen == it.faint else "(no view depends on them)"
    return f"{line}. Left out {it.unseen:,} invisible Gaussians {why}{_describe_change(it.test_change)}"


def _band_bytes(it: TrimReport, degree: int) -> int:
    """Return the bytes of the SH bands above a degree in the PLY that was saved."""
    return 12 * ((it.max_sh_degree + 1) ** 2 - (degree + 1) ** 2) * (it.gaussians - it.unseen)


def lines(it: TrimReport) -> list[str]:
    """Return lines about Gaussians, SH bands and photos, for reports."""
    return [_describe_gaussians(it), _describe_bands(it), _describe_photos(it)]


def _describe_gaussians(it: TrimReport) -> str:
    """Return a line that says how many Gaussians were left out, and how they were found."""
    if it.keep_unseen:
        return "No Gaussian was left out (--keep_unseen)"
    found = f"{it.unseen:,} invisible Gaussians of {it.gaussians:,} were left out{_describe_share(it, it.unseen)}"
    found = found if it.unseen else "No Gaussian was left out"
    searched = f"{it.views} views were searched in {it.seconds:.1f} s"
    how = {
        TOO_LONG: f"only opacities were compared: a search takes {it.views} views, more than a {ITERATIONS_PER_VIEW}th "
        "of the iterations",
        FEW: f"{searched}, with fewer than {100 * WORTH:.0f} % unseen besides",
    }
    return f"{found}; {how.get(it.search, searched)}{_describe_change(it.test_change)}"


def _describe_share(it: TrimReport, count: int) -> str:
    part = count / it.gaussians
    return f" ({100 * part:.1f} %, {it.ply_bytes * part / MB:.2f} MB of the PLY)"


def _describe_change(change: dict[str, float]) -> str:
    """Return the end of a line: the change of the test views and of their PSNR, dB; empty if nothing was measured.

    change: result of `change_on_views`.
    """
    if not change:
        return ""
    text = f"; test views change by at most {change['largest']:.2g} (values 0 to 1)"
    if "psnr_before" in change:
        text += f", PSNR {change['psnr_before']:.3f} to {change['psnr_after']:.3f} dB"
    return text


def _describe_bands(it: TrimReport) -> str:
    """Return a line that says which SH bands were left out, or how far cutting them would move colours."""
    if it.sh_degree < it.max_sh_degree:
        saved = _band_bytes(it, it.sh_degree) / MB
        bound = it.cut_bounds[it.sh_degree]
        moved = f"colours move by at most {bound:.2g} (values 0 to 1)" if bound else "they are zero throughout"
        return f"Left out the SH bands above degree {it.sh_degree} ({saved:.2f} MB of the PLY): {moved}"
    if it.max_sh_degree == 0:
        return "The model has no SH bands above degree 0"
    moved = ", ".join(f"{bound:.2g} above degree {degree}" for degree, bound in enumerate(it.cut_bounds[:-1]))
    return f"All SH bands were kept. Cutting them (--prune_sh) moves colours (values 0 to 1) by at most {moved}"


def _describe_photos(it: TrimReport) -> str:
    """Return a line that says how much memory the training photos take, and how much is saved."""
    saved = 4 * it.picture_bytes_in_files - it.picture_bytes
    return (
        f"Colours of the training photos are kept as bytes and at training size: {it.picture_bytes / MB:.1f} MB, "
        f"{saved / MB:.1f} MB less than as float32 at the size of the files"
    )


def trimmed(run: "Run", scored: bool, iteration: int) -> tuple[GaussianModel, TrimReport]:
    """Return the model of a run without what it does not need, and the facts about that.

    scored: true to compute the change in PSNR, which is cheap if the test photos are in memory.
    iteration: the last one.
    """
    scene, trained, opt, halves = run.scene, run.gaussians, run.opt, run.scene.halves
    trained.optimizer.zero_grad(set_to_none=True)  # room for the trimmed copy
    final, search = trim(trained, scene.getTrainCameras(), run.pipe, opt.keep_unseen, opt.prune_sh, iteration)
    change, test = {}, scene.getTestCameras()
    if test and (search.unseen > search.faint or search.cut_bounds[final.max_sh_degree] > 0):
        change = change_on_views(trained, final, test, ScoredViews(run.pipe, run.background, halves), scored)
    kept_pixels, file_pixels = scene.training_pixels()
    return final, TrimReport(
        gaussians=trained.gaussian_count,
        unseen=search.unseen,
        faint=search.faint,
        keep_unseen=opt.keep_unseen,
        search=search.end,
        views=search.views,
        iterations=iteration,
        max_sh_degree=trained.max_sh_degree,
        sh_degree=final.max_sh_degree,
        cut_bounds=search.cut_bounds,
        ply_bytes=trained.size_as_ply,
        ply_bytes_saved=trained.size_as_ply - final.size_as_ply,
        seconds=round(search.seconds, 3),
        picture_bytes=3 * kept_pixels,
        picture_bytes_in_files=3 * file_pixels,
        test_change={name: value for name, value in change.items() if math.isfinite(value)},
    )
