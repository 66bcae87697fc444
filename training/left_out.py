"""Three lines at the end of a training: what the saved model and the memory leave out, and how much that saves."""

from dataclasses import dataclass, field

MB = 1e6


@dataclass
class LeftOut:
    """Facts that `lines` reports and `model.json` keeps."""

    gaussians: int  # trained
    unseen: int  # of these, not saved, because no training view depends on them
    keep_unseen: bool
    max_sh_degree: int  # trained
    sh_degree: int  # saved
    cut_bounds: list[float]  # by degree: bound on a colour's change if all SH bands above the degree are cut
    ply_bytes: int  # of all Gaussians trained, with all bands
    ply_bytes_saved: int
    seconds: float  # that the search took
    picture_bytes: int  # of the training photos at training size: one byte per colour value
    picture_bytes_in_files: int  # the same at the size of the files
    test_change: dict[str, float] = field(default_factory=dict)  # `trimming.change_on_views`; {} without test views


def lines(left_out: LeftOut) -> list[str]:
    """The lines about Gaussians, SH bands and photos."""
    return [_gaussians(left_out) + _change(left_out.test_change), _bands(left_out), _pictures(left_out)]


def _gaussians(it: LeftOut) -> str:
    if it.keep_unseen:
        return f"Left out no Gaussians (--keep_unseen): {it.gaussians} are saved"
    saved = f"{100 * it.unseen / it.gaussians:.1f} %, {it.ply_bytes * it.unseen / it.gaussians / MB:.2f} MB of the PLY"
    how = f"found in {it.seconds:.1f} s"
    return f"Left out {it.unseen} of {it.gaussians} Gaussians ({saved}) that no training view depends on, {how}"


def _change(change: dict[str, float]) -> str:
    if not change:
        return ""
    text = f"; test views change by at most {change['largest']:.2g} (values 0 to 1)"
    if "psnr_before" in change:
        text += f", PSNR {change['psnr_before']:.3f} to {change['psnr_after']:.3f} dB"
    return text


def _bands(it: LeftOut) -> str:
    if it.sh_degree < it.max_sh_degree:
        rows = it.gaussians - it.unseen
        saved = 12 * ((it.max_sh_degree + 1) ** 2 - (it.sh_degree + 1) ** 2) * rows / MB
        moved = f"colours move by at most {it.cut_bounds[it.sh_degree]:.2g} (values 0 to 1)"
        return f"Left out the SH bands above degree {it.sh_degree} ({saved:.2f} MB of the PLY): {moved}"
    if it.max_sh_degree == 0:
        return "Left out no SH bands: there are none above degree 0"
    moved = ", ".join(f"{bound:.2g} above degree {degree}" for degree, bound in enumerate(it.cut_bounds[:-1]))
    return f"Left out no SH bands; cutting them would move colours by at most {moved} (--prune_sh)"


def _pictures(it: LeftOut) -> str:
    saved = 4 * it.picture_bytes_in_files - it.picture_bytes
    return (
        f"Colours of the training photos are kept as bytes and at training size: {it.picture_bytes / MB:.1f} MB, "
        f"{saved / MB:.1f} MB less than as float32 at the size of the files"
    )
