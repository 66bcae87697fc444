"""Advice for a training whose test views were better before its end."""

from collections.abc import Container

from records.error_curve import Row, best_test, whole_sets

CLEAR = 0.1  # dB between best and last point; points of a settled training differed by up to 0.07


def schedules_follow_length(
    depths: bool, train_test_exp: bool, resolution_schedule: str = "none", rates: bool = False
) -> bool:
    """Whether a schedule follows --iterations: depth loss's weight, exposures' learning rate, or views' sizes.

    rates: whether the other learning rates do.
    """
    return depths or train_test_exp or resolution_schedule != "none" or rates


def peak_advice(
    rows: list[Row], saved: Container[int], position_lr_max_steps: int | None, follows_length: bool = False
) -> str | None:
    """A line that names the iteration with the best test views; None unless they were clearly worse in the last row.

    Rows that score a subset of the views do not count. saved: iterations whose PLY this training has written.
    follows_length: `schedules_follow_length`. position_lr_max_steps: None for a run whose pace is not steady, of which
    no other length ends with that model.

    A PLY is written before its iteration's step, so a saved one is the model that was scored; its exposures are those
    of the last save. A training of fewer --iterations ends with the same model, unless a schedule follows its length.
    """
    rows = whole_sets(rows)
    best = best_test(rows)
    if best is None or rows[-1]["test_psnr"] is None:
        return None
    lost = best["test_psnr"] - rows[-1]["test_psnr"]
    if lost < CLEAR:
        return None
    iteration = best["iteration"]
    line = (
        f"Test views were best at iteration {iteration}: PSNR {best['test_psnr']:.2f} dB, {lost:.2f} dB above the end"
    )
    if None not in (best["train_psnr"], rows[-1]["train_psnr"]):
        line += f" (train views {best['train_psnr']:.2f} there, {rows[-1]['train_psnr']:.2f} at the end)"
    if iteration in saved:
        line += f"; that model is saved, use it with render.py --iteration {iteration}"
    elif position_lr_max_steps is None:
        return line
    elif follows_length:
        line += f"; --save_iterations {iteration} saves that model during the training"
    else:
        line += f"; --iterations {iteration} ends with that model, --save_iterations {iteration} also saves it"
    if position_lr_max_steps is not None and iteration < position_lr_max_steps:
        length = f"--iterations {iteration} " if follows_length else ""
        line += (
            f"; {length}--position_lr_max_steps {iteration} {'' if follows_length else 'as well '}is a different "
            f"training: its learning rate of positions falls by then instead of by {position_lr_max_steps}"
        )
    return line
