"""Our own JSON files."""

import json
import os

import pytest

from splatting.files.json_files import read_json, write_json


def test_names_of_any_kind_come_back_and_stay_readable(tmp_path):
    path = tmp_path / "new" / "a.json"
    content = {"photos": ["Straße.jpg", "写真.jpg", os.fsdecode(b"\xff.jpg"), "\U0001f30d"], "a": 1}
    write_json(path, content)
    assert read_json(path) == content == json.loads(path.read_bytes())
    text = path.read_text(encoding="utf-8")
    assert "Straße.jpg" in text and "写真.jpg" in text and text.endswith("}\n")
    assert text.index('"a"') < text.index('"photos"')
    write_json(path, content, sort_keys=False)
    assert list(read_json(path)) == ["photos", "a"]


def test_no_nan_and_the_old_file_stays(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, [1])
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(path, [float("nan")])
    assert read_json(path) == [1] and os.listdir(tmp_path) == ["a.json"]
