"""Other implementations' figures on the workloads S to XL, and the marks we aim at: ms and MiB on one NVIDIA H200.

The figures were measured in one run (torch 2.11+cu130, CUDA 13.0; medians, host included), on the tensors that
splat_scenes.frustum draws on the GPU with seed 0. STEPS are forward, forward + backward, and both with one dense Adam
step of all tensors.
"""

STEPS = ("forward", "+ backward", "step")

FASTER_GS = {
    "S": (0.41, 1.16, 1.21),
    "M": (0.80, 2.89, 3.29),
    "M+": (1.07, 3.61, 4.03),
    "L": (1.65, 6.19, 7.39),
    "XL": (2.40, 9.73, 12.1),
}
GSPLAT = {
    "S": (1.11, 2.47, 2.95),
    "M": (1.79, 4.64, 5.48),
    "M+": (2.11, 5.68, 6.61),
    "L": (3.83, 9.62, 11.5),
    "XL": (6.16, 15.2, 18.9),
}
# Peak memory above the inputs: of forward alone, and of forward + backward, gradients included.
FASTER_GS_MEMORY = {"S": (29, 133), "M+": (159, 900), "L": (362, 2175), "XL": (651, 3942)}
GSPLAT_MEMORY = {"S": (50, 54), "M+": (411, 482), "L": (1127, 1397), "XL": (2169, 2772)}

# Marks for the time of the kernels (the step's includes loss and density statistics) and the memory of + backward.
MARKS = {
    "S": (0.18, 0.42, 0.50),
    "M": (0.35, 1.0, 1.4),
    "M+": (0.45, 1.25, 1.7),
    "L": (0.80, 2.2, 3.2),
    "XL": (1.3, 3.3, 5.0),
}
MEMORY_MARKS = {"S": 70, "M": 400, "M+": 420, "L": 1126, "XL": 2150}
