"""A scorer: renders by `render_sets`, scores the PNG files by itself and by `metrics.evaluate`.

SCENE MODEL OUT
"""

import json
import os
import shutil
import sys
from argparse import ArgumentParser, Namespace

import torch

import metrics
import render
from arguments import ModelParams, PipelineParams
from lpipsPyTorch import lpips
from utils.image_utils import psnr
from utils.loss_utils import ssim

source, model, out = sys.argv[1:4]
folder = os.path.join(out, "model")
shutil.copytree(model, folder)
shutil.rmtree(os.path.join(folder, "test"), ignore_errors=True)
parser = ArgumentParser()
lp, pp = ModelParams(parser, sentinel=True), PipelineParams(parser)
with open(os.path.join(folder, "cfg_args")) as file:
    stored = eval(file.read(), {"Namespace": Namespace})
stored.model_path = folder
with torch.no_grad():
    render.render_sets(lp.extract(stored), 300, pp.extract(Namespace()), True, False, False)
    render.render_sets(
        lp.extract(stored), -1, pp.extract(Namespace()), skip_train=False, skip_test=True, separate_sh=True
    )

method = os.path.join(folder, "test", "ours_300")
renders, gts, names = metrics.readImages(os.path.join(method, "renders"), os.path.join(method, "gt"))
scores = {"SSIM": [], "PSNR": [], "LPIPS": []}
with torch.no_grad():
    for image, truth in zip(renders, gts, strict=True):
        scores["SSIM"].append(ssim(image, truth).item())
        scores["PSNR"].append(psnr(image, truth).item())
        scores["LPIPS"].append(lpips(image, truth, net_type="vgg").item())
    same = lpips(gts[0], gts[0], net_type="vgg")
metrics.evaluate([folder])
with open(os.path.join(folder, "results.json")) as file:
    results = json.load(file)["ours_300"]
with open(os.path.join(folder, "per_view.json")) as file:
    per_view = json.load(file)["ours_300"]
result = {
    "names": sorted(names),
    "train": len(os.listdir(os.path.join(folder, "train", "ours_300", "renders"))),
    "shapes": [list(renders[0].shape), str(renders[0].dtype), renders[0].device.type],
    "scores": {name: sum(values) / len(values) for name, values in scores.items()},
    "results": results,
    "per_view": {name: [per_view[name][view] for view in names] for name in scores},
    "own": scores,
    "same": [same.item(), same.numel()],
}
with open(os.path.join(out, "result.json"), "w") as file:
    json.dump(result, file)
