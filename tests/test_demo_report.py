"""The demo's report: its table and sheet, and a message for every missing or damaged part of a model."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatting.demo import report
from splatting.evaluation.renders import ComparedViews
from utils.system_utils import UserError

RESULTS = {"ours_30": {"SSIM": 0.5, "PSNR": 20.0, "LPIPS": None}}
PLY = "point_cloud/iteration_30/point_cloud.ply"
PER_VIEW = {"ours_30": {"PSNR": {"00000.png": 19.0, "00001.png": 21.0}}}


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """A model folder as train.py, render.py and metrics.py leave it."""
    folder = tmp_path / "model"
    ply = folder / PLY
    ply.parent.mkdir(parents=True)
    ply.write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 123\nend_header\n")
    for side in ("renders", "gt"):
        (folder / "test" / "ours_30" / side).mkdir(parents=True)
        for name in PER_VIEW["ours_30"]["PSNR"]:
            Image.fromarray(np.zeros((20, 30, 3), np.uint8)).save(folder / "test" / "ours_30" / side / name)
    (folder / "cfg_args").write_text("Namespace(source_path='/data/garden')")
    (folder / "results.json").write_text(json.dumps(RESULTS))
    (folder / "per_view.json").write_text(json.dumps(PER_VIEW))
    (folder / "train_log.json").write_text(json.dumps([{"iteration": 30, "seconds": 12.4, "gaussians": 123}]))
    return folder


@pytest.fixture
def run(model, monkeypatch) -> Callable[[], None]:
    monkeypatch.setattr("sys.argv", ["report", str(model)])
    return report.main


@pytest.mark.filterwarnings("error::ResourceWarning")
def test_table_and_sheet(run, model, capsys):
    run()
    lines = capsys.readouterr().out.splitlines()
    cells = lines[1].split()
    assert cells == ["garden", "30", "12", "s", "123", "2", "20.00", "dB", "0.5000"]
    assert lines[-2].endswith(f" {model / 'contact_sheet.png'}") and lines[-1].endswith(f"view.py -m {model}")
    with Image.open(model / "contact_sheet.png") as sheet:
        assert sheet.width > 90


@pytest.mark.parametrize("text", ["{broken", '[{"iteration": 30, "seconds": "x"}]'])
def test_a_damaged_log_only_costs_the_time(run, model, capsys, text):
    (model / "train_log.json").write_text(text)
    run()
    printed = capsys.readouterr()
    assert "garden" in printed.out and "12 s" not in printed.out and "train_log.json cannot be read" in printed.err


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        *((name, text, "no scores of ours_30; run render.py and metrics.py")
          for name in ("results.json", "per_view.json")
          for text in ("[]", "{", '{"ours_30": {"PSNR": {}}}', '{"ours_30": {"PSNR": "x", "SSIM": 1}}')),
        (PLY, None, "cannot read .*point_cloud.ply"),
        ("test/ours_30/gt/00001.png", None, "gt/00001.png is missing or damaged.*; run render.py"),
        ("test/ours_30/gt/00001.png", "x", "gt/00001.png is missing or damaged.*; run render.py"),
    ],
)  # fmt: skip
def test_missing_and_damaged_files_are_named(run, model, name, text, sentence):
    (model / name).unlink() if text is None else (model / name).write_text(text)
    with pytest.raises(UserError, match=sentence):
        run()
    assert not (model / "contact_sheet.png").exists()


def test_views_without_a_psnr_are_on_no_sheet(model, tmp_path):
    """Equal images have none, and other option sets may have none of other views."""
    (model / "per_view.json").write_text(json.dumps({"ours_30": {"PSNR": dict.fromkeys(("00000.png", "00001.png"))}}))
    views = ComparedViews([{"config": None, "model": "model", "final_iteration": 30}], tmp_path)
    with pytest.raises(UserError, match="no view has a PSNR"):
        views.draw_worst(tmp_path / "sheet.png")
    assert views.shown(3) == []
