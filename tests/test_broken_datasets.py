"""Every fault of broken_datasets.py is answered in one sentence that a user can act on."""

import re
from pathlib import Path

import pytest
from broken_datasets import FAULTS, Fault, make_masters, message


@pytest.fixture(scope="module")
def masters(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return make_masters(tmp_path_factory.mktemp("masters"))


def test_there_are_forty_different_ones():
    assert len({fault.what for fault in FAULTS}) == len(FAULTS) >= 40


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.what)
def test_one_sentence_that_names_the_thing_and_the_remedy(fault, masters, tmp_path):
    text = message(fault, masters, tmp_path)
    assert "\n" not in text and "Traceback" not in text
    # The file, folder or option at fault, and after the semicolon what to do.
    assert re.search(r"SCENE|OUT| -[a-z]|left/v02.png|Right/V03.png", text), text
    what, semicolon, remedy = text.rpartition("; ")
    assert semicolon and len(what) > 15 and len(remedy.split()) >= 3, text


def test_a_sound_scene_is_taken(masters, tmp_path):
    for kind in masters:
        (tmp_path / kind).mkdir()
        with pytest.raises(AssertionError, match="is taken"):
            message(Fault("none", kind, lambda scene: None), masters, tmp_path / kind)
