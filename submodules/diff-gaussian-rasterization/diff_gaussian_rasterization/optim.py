"""Updates in place for training: steps of Adam, and the statistics of adaptive density control.

Results have the same bits for any number of threads. Nothing here is differentiable. RuntimeError names the argument
whose shape, dtype, device or layout does not fit; then nothing was changed.

A guard may hold steps back. It is given by the last three arguments: `loss`, the scalar loss of this iteration;
`stopped`, one int64 on the parameters' device, 0 at the start; and `iteration`, counted from 1. The first iteration
whose loss or step is not finite is written to `stopped`, and no later iteration takes a step. In that iteration a value
whose step would not be finite keeps its value, and its exp_avg becomes NaN as a mark. Without `stopped` there is
no guard.
"""

from collections.abc import Sequence

from torch import Tensor

from diff_gaussian_rasterization.backend import OPERATORS

_adam = OPERATORS.adam_
_observe = OPERATORS.observe_


def adam_(
    values: Sequence[Tensor],
    gradients: Sequence[Tensor],
    exp_avgs: Sequence[Tensor],
    exp_avg_sqs: Sequence[Tensor],
    steps: Sequence[Tensor],
    rates: Sequence[float],
    beta1: float,
    beta2: float,
    eps: float,
    columns: Sequence[int],
    loss: Tensor | None = None,
    stopped: Tensor | None = None,
    iteration: int = 0,
    rows: Tensor | None = None,
) -> None:
    """Takes one step of Adam (Kingma and Ba 2015, algorithm 1, eps as in torch.optim.Adam) of several parameters.

    Each list has an entry for every parameter. values, gradients and both averages: tensors of one shape (N, ...), all
    parameters of one dtype (float32, or on the CPU float64) and device; all but gradients contiguous. steps: one
    float32 each, on the CPU, the number of steps taken before. rates: learning rates. columns: how many leading values
    of each row take part, -1 for all. rows: (N,) bool, those that step, the others keep every bit; None: all.
    Changes values, exp_avgs, exp_avg_sqs and `stopped`, and adds 1 to every entry of steps, even if the guard holds
    the step back.
    """
    lists = values, gradients, exp_avgs, exp_avg_sqs, steps
    _adam(*lists, rates, beta1, beta2, eps, columns, rows, loss, stopped, iteration)


def sparse_adam_(
    value: Tensor,
    gradient: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    visible: Tensor,
    rate: float,
    beta1: float,
    beta2: float,
    eps: float,
    columns: int = -1,
    loss: Tensor | None = None,
    stopped: Tensor | None = None,
    iteration: int = 0,
) -> None:
    """Takes one step of sparse Adam (Mallick et al. 2024, Taming 3DGS) of one parameter's visible rows.

    value, gradient and both averages: (N, ...) as for `adam_`, but with any strides. visible: (N,) bool. There is no
    bias correction. Changes value, exp_avg, exp_avg_sq and `stopped`; rows that are not visible keep every bit.
    """
    given = value, exp_avg, exp_avg_sq
    packed = [tensor.contiguous() for tensor in given]  # the same tensor, unless its strides are others
    tensors = [packed[0]], [gradient], [packed[1]], [packed[2]], []
    _adam(*tensors, [rate], beta1, beta2, eps, [columns], visible, loss, stopped, iteration)
    for old, new in zip(given, packed, strict=True):
        if new is not old:
            old.copy_(new)


def observe_(max_radii: Tensor, gradient_sums: Tensor, views: Tensor, radii: Tensor, gradient: Tensor) -> None:
    """Adds a view to the statistics of adaptive density control (Kerbl et al. 2023, section 5.2).

    max_radii, gradient_sums, views: N float32 values each, contiguous. radii: (N,) int32 px, 0 where not seen.
    gradient: (N, 3) float32, d loss / d mean on the image, per NDC unit; the third column is not read. Or (N,): lengths
    that stand for those of gradients.
    Where radii > 0, raises max_radii to radii, adds the length of the gradient to gradient_sums and 1 to views.
    """
    _observe(max_radii, gradient_sums, views, radii, gradient)
