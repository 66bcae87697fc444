"""A wrapper that runs train.py and render.py within its own process, and train.py once more through a shell.

SCENE MODEL OUT
"""

import json
import os
import runpy
import shlex
import sys
from pathlib import Path

from PIL import Image

import arguments
import utils.camera_utils as camera_utils
from scene.cameras import Camera

REPOSITORY = Path(arguments.__file__).resolve().parents[1]
calls = []


def load_half(args, id, cam_info, resolution_scale, is_nerf_synthetic, is_test_dataset):
    calls.append(cam_info.image_name)
    image = Image.open(cam_info.image_path)
    size = round(image.width / 2 / resolution_scale), round(image.height / 2 / resolution_scale)
    return Camera(size, colmap_id=cam_info.uid, R=cam_info.R, T=cam_info.T, FoVx=cam_info.FovX, FoVy=cam_info.FovY,
                  depth_params=cam_info.depth_params, image=image, invdepthmap=None, image_name=cam_info.image_name,
                  uid=id, data_device=args.data_device, train_test_exp=args.train_test_exp,
                  is_test_dataset=is_test_dataset, is_test_view=cam_info.is_test)  # fmt: skip


def run_script(name, *words):
    """Run a script of the project as its command line does; returns how many photos it loaded by our function."""
    camera_utils.loadCam = load_half
    before, argv = len(calls), sys.argv
    sys.argv = [name, *map(str, words)]
    try:
        runpy.run_path(str(REPOSITORY / name), run_name="__main__")
    except SystemExit as stop:
        if stop.code:
            raise
    finally:
        sys.argv = argv
    return len(calls) - before


if __name__ == "__main__":
    source, _, out = sys.argv[1:4]
    port = sys.argv[4]
    half, whole = os.path.join(out, "half"), os.path.join(out, "whole")
    options = "--eval --iterations 30 --test_iterations 30 --save_iterations 30"
    result = {"train": run_script("train.py", "-s", source, "-m", half, "--disable_viewer", *options.split())}
    result["render"] = run_script("render.py", "-m", half, "--skip_train")
    words = f"{sys.executable} train.py -s {shlex.quote(source)} --port {port} --model_path {shlex.quote(whole)}"
    result["status"] = os.system(f"cd {shlex.quote(str(REPOSITORY))} && {words} {options}")
    with Image.open(os.path.join(half, "test", "ours_30", "renders", "00000.png")) as picture:
        result["size"] = picture.size
    with open(os.path.join(out, "result.json"), "w") as file:
        json.dump(result, file)
