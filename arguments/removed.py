"""Options that are gone, and what to do instead. Commands refuse them by name for one release."""

_CONSTANT = "its default is now the only value; leave it out"

REMOVED: dict[str, str] = {
    "target_psnr": "bound the seconds instead, and read what is reached from error_vs_time.csv",
    "refine_lens": "let the program that placed the photos refine their lenses",
    "parallel": "leave it out, as processes of torchrun always share each view by tiles",
    "whole_curve": "leave it out, as the last point of the curve scores all test views",
    "viewer_exit": "leave it out; the page ends by its button or by Ctrl-C",
    "mcmc_gate_steepness": _CONSTANT,
    "mcmc_gate_opacity": _CONSTANT,
    "mcmc_parts": _CONSTANT,
    "growth_power": _CONSTANT,
    "score_power": _CONSTANT,
    "score_views": _CONSTANT,
}
