"""Gaussians on rays: what is refused, what has no extent, and what a training with them says.

Images and gradients: test_rasterizer_oracle.py.
"""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from diff_gaussian_rasterization.lens import Lens
from PIL import Image
from rasterizer_tools import few, leaves, render

import export
import render as command
import train
from gaussian_renderer import rasterizer_settings
from tests.workloads.splat_scenes import settings

SMALL = Lens("equidistant", (9.0, 9.0), (8.5, 3.0))


def test_cameras_get_no_gradients_on_rays():
    parameters, arguments = few()
    view = settings(**arguments, projection="ray")
    view.viewmatrix.requires_grad_()
    with pytest.raises(RuntimeError, match="'ray' has no gradients of cameras: take 'ewa'"):
        render(parameters, view).color.sum().backward()


@pytest.mark.parametrize("lens", [None, SMALL], ids=["pinhole", "fisheye"])
def test_a_gaussian_of_no_extent_along_an_axis_has_gradients(lens):
    parameters, arguments = few(1)
    parameters["scales"][:, 2] = -math.inf
    inputs = leaves(parameters)
    render(inputs, settings(**arguments, projection="ray", lens=lens)).color.sum().backward()
    assert all(values.grad.isfinite().all() for values in inputs.values())


def test_a_view_takes_the_projection_of_the_options():
    still = SimpleNamespace(world_view_transform=None, full_proj_transform=None, camera_center=None)
    camera = SimpleNamespace(image_height=7, image_width=18, FoVx=1.0, FoVy=1.0, lens=SMALL, **vars(still))
    model, pipe = SimpleNamespace(active_sh_degree=0), SimpleNamespace(debug=False, projection="ray")
    made = rasterizer_settings(camera, model, pipe, torch.zeros(3))
    assert made.projection == "ray" and made.lens is SMALL
    assert rasterizer_settings(camera, model, SimpleNamespace(debug=False), torch.zeros(3)).projection == "ewa"


def test_a_training_on_rays_renders_so_and_exports_say_it(colmap_scene, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    train.main(["-s", str(colmap_scene), "-m", str(out), "--iterations", "30", "--projection", "ray"])
    assert json.loads((out / "model.json").read_text())["projection"] == "ray"
    images = []
    for given, mark in (([], ""), (["--projection", "ewa"], "_projection_ewa")):
        monkeypatch.setattr("sys.argv", ["render.py", "-m", str(out), "--skip_test", *given])
        command.main()
        renders = out / f"train/ours_30{mark}/renders"
        images.append([np.asarray(Image.open(path)) for path in sorted(renders.glob("*.png"))])
    assert 0 < np.abs(np.subtract(*images, dtype=int)).max() < 100
    monkeypatch.setattr("sys.argv", ["export.py", "-m", str(out), "--to", str(tmp_path / "model.splat")])
    export.main()
    assert "trained with --projection ray; other programs draw large Gaussians off axis" in capsys.readouterr().out
