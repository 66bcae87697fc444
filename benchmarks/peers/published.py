"""Workloads, other implementations' figures on them, and the marks we aim at: milliseconds and MiB on one NVIDIA H200.

The figures were measured in one run (torch 2.11+cu130, CUDA 13.0; medians, host included), on the tensors that
splat_scenes.frustum draws on the GPU with seed 0. STEPS are forward, forward + backward, and both with one dense Adam
step of all tensors.
"""

STEPS = ("forward", "+ backward", "step")

#            splats    width height median pixel sigma
WORKLOADS = {
    "S": (100_000, 800, 800, 2.4),
    "M": (1_000_000, 1000, 1000, 1.4),
    "M+": (1_000_000, 1600, 1060, 1.7),
    "L": (3_000_000, 1600, 1060, 1.3),
    "XL": (6_000_000, 1600, 1060, 1.1),
}

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

# The call, host included, must stay below these fractions of Faster-GS's times.
BINDING = {"forward": 0.6, "+ backward": 0.5}

# Marks for the time of the kernels (the step's includes loss and density statistics) and the memory of + backward.
MARKS = {
    "S": (0.18, 0.42, 0.50),
    "M": (0.35, 1.0, 1.4),
    "M+": (0.45, 1.25, 1.7),
    "L": (0.80, 2.2, 3.2),
    "XL": (1.3, 3.3, 5.0),
}
MEMORY_MARKS = {"S": 70, "M": 400, "M+": 420, "L": 1126, "XL": 2150}

# Limits of the H200: bytes copied per second, lane instructions per second (132 SMs, 128 lanes, 1.98 GHz).
BANDWIDTH = 4.3e12
INSTRUCTIONS = 33.5e12


def floors(splats: int, pixels: int, instances: int, processed: int, evaluated: float) -> dict[str, float]:
    """Return the least milliseconds that the chip needs for each stage: every byte moved once, an ideal blend.

    evaluated: fragments per pixel with 8x4 sub-tiles. A Gaussian has 11 floats of geometry and 48 of SH, 45 of them
    beyond the first band. A packed splat has 12 floats, a row of gradient sums 9.
    """
    read, moments, gradients = 44 + 180, 36, 236
    of_bytes = {
        "project": splats * (read + 48),
        # Depths: 4 passes of 8 bits over key and index. Instances: written, then 2 passes over 6 bytes.
        "bin": splats * 4 * 16 + instances * (6 + 2 * 12),
        "blend": 0,
        "blend_vjp": processed * 2 * moments,
        "project_vjp": splats * (read + moments + gradients),
        "adam": splats * 59 * 4 * 7,
    }
    of_instructions = {"blend": 15, "blend_vjp": 45}
    fragments = pixels * evaluated
    return {
        stage: 1e3 * (n / BANDWIDTH + fragments * of_instructions.get(stage, 0) / INSTRUCTIONS)
        for stage, n in of_bytes.items()
    }
