"""The worked examples' entries of arguments/features.py."""

from arguments.features import FEATURES, Options
from arguments.option import Option, at_least

# fmt: off
FEATURES.update({
    "patient": Options(
        strategy="as adc, but Gaussians grow only after --patience densifications in a row with a large gradient",
        optimisation=(
            Option("patience", 2, origin="ours", check=at_least(1),
                help="patient: densifications in a row in which a Gaussian's gradient reaches densify_grad_threshold "
                     "before it is cloned or split; 1: as adc"),
        )),
    "grey": Options(optimisation=(
        Option("grey", 0.0, origin="ours", check=at_least(0),
            help="weight of the spread of colours in renders, which draws them towards grey; 0: off"),
    )),
})
# fmt: on
