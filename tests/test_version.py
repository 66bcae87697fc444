"""The version: written once, equal everywhere, in every model and checkpoint; the release notes of it."""

import importlib.metadata
import re
import subprocess
import sys
from pathlib import Path

import torch
from gaussians import model, take_steps

from applications.doctor.environment import EXTENSIONS
from arguments import VERSION
from groundwork.host.machine import VERSION as WRITTEN
from scene.gaussians.checkpoint import WRITTEN_BY, save_checkpoint

ROOT = Path(__file__).resolve().parents[1]
NOTES = ROOT / ".ci" / "release_notes.py"


def test_the_version_is_one():
    assert re.fullmatch(r"\d+\.\d+\.\d+", WRITTEN)
    assert (ROOT / "version.txt").read_text() == f"{WRITTEN}\n"
    assert VERSION == WRITTEN
    assert {name: importlib.metadata.version(name) for name in EXTENSIONS} == dict.fromkeys(EXTENSIONS, WRITTEN)
    setup = [sys.executable, "setup.py", "--quiet", "--version"]
    said = subprocess.run(setup, cwd=ROOT, capture_output=True, text=True, check=True)
    assert said.stdout.splitlines()[-1] == WRITTEN
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.findall(r"^version: (.+)$", citation, re.MULTILINE) == [WRITTEN]


def test_a_checkpoint_has_it_where_no_reader_stumbles(tmp_path):
    """torch's Adam, which the reference's restore hands entry 10 to, takes the state with the version in it."""
    gaussians = model(5)
    take_steps(gaussians, 2)
    save_checkpoint(tmp_path / "chkpnt2.pth", gaussians.capture(), 2)
    capture, iteration = torch.load(tmp_path / "chkpnt2.pth", weights_only=True)
    assert (len(capture), iteration) == (12, 2)
    assert capture[10][WRITTEN_BY] == WRITTEN
    groups = [{"params": [torch.nn.Parameter(t.detach())], "name": str(i)} for i, t in enumerate(capture[1:7])]
    theirs = torch.optim.Adam(groups, lr=0.0, eps=1e-15)
    theirs.load_state_dict(capture[10])
    assert set(theirs.state_dict()) == {"state", "param_groups"}
    assert all(len(theirs.state[group["params"][0]]) == 3 for group in theirs.param_groups)


def test_release_notes_are_the_section_of_the_version():
    done = subprocess.run([sys.executable, NOTES, f"v{WRITTEN}"], capture_output=True, text=True, check=True)
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    section = changelog.split(f"## [{WRITTEN}] - ")[1].split("\n## [")[0]
    assert done.stdout.count("\n- ") == section.count("\n- ") > 10 and "\n## " not in done.stdout
    assert f'date-released: "{section[:10]}"' in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    done = subprocess.run([sys.executable, NOTES, "0.0.0"], capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.startswith(f"error: version.txt says {WRITTEN}, not 0.0.0;")
