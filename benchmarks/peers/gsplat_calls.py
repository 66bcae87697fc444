"""gsplat 1.5.3 (PyPI) on our scenes. It compiles its kernels for the machine's GPU on first use, which takes minutes.

Activations and the concatenation of the SH bands count as part of the call, as they do for ours. The step is torch's
fused Adam over all tensors.
"""

import importlib.metadata
from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks.harness.calls import image_gradient
from benchmarks.workloads.splat_scenes import SplatScene
from utils.system_utils import UserError

INSTALL = "pip install gsplat==1.5.3 (needs nvcc and ninja; with TORCH_CUDA_ARCH_LIST=9.0 it builds for one GPU only)"


def version() -> str:
    """Return gsplat's version; UserError if it is not installed or cannot build its kernels."""
    try:
        from gsplat.cuda._backend import _C  # compiles the kernels on first use
    except ImportError as error:
        raise UserError(f"--peers gsplat: {error}; {INSTALL}") from error
    if _C is None:
        raise UserError(f"--peers gsplat: it found no nvcc to build its kernels with; {INSTALL}")
    return importlib.metadata.version("gsplat")


class GsplatCalls:
    """gsplat's counterpart of harness.calls.Calls.

    packed: use gsplat's packed layout, the default of its function but not of its trainer.
    """

    def __init__(self, scene: SplatScene, packed: bool) -> None:
        self.scene, self.packed = scene, packed
        self.leaves = scene.leaves(torch.float32)
        self.gradient = image_gradient(scene)
        settings = scene.settings(torch.float32)
        focal_x, focal_y = scene.width / (2 * settings.tanfovx), scene.height / (2 * settings.tanfovy)
        rows = [[focal_x, 0, scene.width / 2], [0, focal_y, scene.height / 2], [0, 0, 1]]
        self.camera = {
            "viewmats": settings.viewmatrix.T[None].contiguous(),
            "Ks": torch.tensor([rows], device=self.gradient.device),
            # gsplat 1.5.3 checks the background's shape against its packed means, which have no camera dimension.
            "backgrounds": settings.bg if packed else settings.bg[None],
            "width": scene.width,
            "height": scene.height,
        }
        self._adam: torch.optim.Adam | None = None

    def render(self) -> Tensor:
        """Return the image, (3, H, W)."""
        from gsplat import rasterization

        p = self.leaves
        image, _, _ = rasterization(
            p["means"],
            p["rotations"],
            p["scales"].exp(),
            p["opacities"].sigmoid().squeeze(1),
            torch.cat([p["sh_dc"], p["sh_rest"]], 1),
            sh_degree=3,
            packed=self.packed,
            **self.camera,
        )
        return image[0].permute(2, 0, 1)

    @torch.no_grad()
    def forward(self) -> Tensor:
        return self.render()

    def with_backward(self) -> None:
        self.clear()
        self.render().backward(self.gradient)

    def step(self) -> None:
        """Do a step with learning rate 0, which has the arithmetic of a step but leaves the scene as it was."""
        self.with_backward()
        if self._adam is None:
            self._adam = torch.optim.Adam(self.leaves.values(), lr=0.0, eps=1e-15, fused=True)
        self._adam.step()

    def clear(self) -> None:
        for t in self.leaves.values():
            t.grad = None

    def steps(self) -> dict[str, Callable[[], object]]:
        return {"forward": self.forward, "+ backward": self.with_backward, "step": self.step}
