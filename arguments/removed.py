"""Options that are gone, and what to do instead. Commands refuse them by name for one release."""

_CONSTANT = "its default is now the only value; leave it out"

REMOVED: dict[str, str] = {
    "target_psnr": "limit the seconds of training instead, and read the PSNR from error_vs_time.csv",
    "refine_lens": "refine lenses in the program that estimates the poses",
    "parallel": "leave it out; processes of torchrun always divide each view into tiles",
    "whole_curve": "leave it out, as the last point of the curve scores all test views",
    "viewer_exit": "leave it out; the page ends by its button or by Ctrl-C",
    "mcmc_gate_steepness": _CONSTANT,
    "mcmc_gate_opacity": _CONSTANT,
    "mcmc_parts": _CONSTANT,
    "growth_power": _CONSTANT,
    "score_power": _CONSTANT,
    "score_views": _CONSTANT,
}
