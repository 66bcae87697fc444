"""Pictures of tabs in a browser, and our renders of what they should show."""

import io
import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from gaussians import pipeline
from PIL import Image

from gaussian_renderer import render
from scene.with_splats import model_of

if TYPE_CHECKING:
    from playwright.sync_api import Page

    from scene.cameras import MiniCam
    from scene.splats.splats import Splats

BACKGROUND = 0.2, 0.4, 0.3
SECONDS = 120  # until something must have happened; a busy machine takes many times as long as an idle one


def until(holds: Callable[[], bool], what: str) -> None:
    """Wait until a condition holds. what: what is wrong if it never does."""
    deadline = time.monotonic() + SECONDS
    while not holds():
        assert time.monotonic() < deadline, what
        time.sleep(0.1)


def picture(tab: "Page") -> np.ndarray:
    """Return the picture of a tab, (height, width, 3) in 0 to 255."""
    return np.asarray(Image.open(io.BytesIO(tab.screenshot())).convert("RGB"), np.float64)


def settled(tab: "Page") -> np.ndarray:
    """The picture, once it does not change for a second, as viewers sort in other threads, which a busy machine delays.

    One of a single colour was taken before anything was drawn.
    """
    before, equal = picture(tab), 0
    for _ in range(4 * SECONDS):
        tab.wait_for_timeout(250)
        now = picture(tab)
        equal = equal + 1 if np.array_equal(now, before) and (now != now[0, 0]).any() else 0
        if equal == 4:
            return now
        before = now
    pytest.fail(f"the picture is not at rest after {SECONDS} s")


def expected(splats: "Splats", camera: "MiniCam") -> np.ndarray:
    """Our render before BACKGROUND, as `picture`."""
    with torch.no_grad():
        image = render(camera, model_of(splats), pipeline(antialiasing=splats.antialiasing), torch.tensor(BACKGROUND))
    return image["render"].clamp(0, 1).permute(1, 2, 0).numpy() * 255.0


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    """Return the PSNR of two pictures, dB."""
    return 10 * math.log10(255**2 / np.square(one - other).mean())
