"""The notebook docs/notebooks/first_scene.ipynb: it is stored as before its first run, and all cells run."""

import html
import re
import zipfile
from collections.abc import Callable
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

import applications.demo  # noqa: F401  (whose scene the notebook makes)

ROOT = Path(__file__).resolve().parents[1]
FILE = ROOT / "docs/notebooks/first_scene.ipynb"
# Colab's module, whose dialogs have an answer each.
COLAB = """
import sys
from types import ModuleType, SimpleNamespace

answers = {answers}
colab = ModuleType("google.colab")
colab.files = SimpleNamespace(upload=lambda: {{answers.pop(0): b""}}, download=lambda path: print("downloads:", [path]))
sys.modules |= {{"google": ModuleType("google"), "google.colab": colab}}
"""
# Programs that print and write at once what the notebook shows of the real ones, by name.
_HEAD = """
import sys
from pathlib import Path
from PIL import Image
words = dict(zip(sys.argv[1::2], sys.argv[2::2]))
"""
PROGRAMS = {
    "convert": 'count = len([*Path(words["-s"], "input").iterdir()])\nprint(count, "of", count, "photos placed")',
    "train": """
assert len([*Path(words["-s"], "input").iterdir()]) == 3
ply = Path(words["-m"], "point_cloud/iteration_9/point_cloud.ply")
ply.parent.mkdir(parents=True)
ply.touch()
Image.new("L", (8, 8)).save(Path(words["-m"], "error_vs_time.png"))
""",
    "export": """
Path(words["--to"]).write_text("<p>the page</p>")
Image.new("L", (8, 8)).save(words["--to"] + ".jpg")
""",
}


def _read() -> nbformat.NotebookNode:
    return nbformat.read(FILE, as_version=4)


def _parameters(book: nbformat.NotebookNode) -> nbformat.NotebookNode:
    (cell,) = [cell for cell in book.cells if "parameters" in cell.metadata.get("tags", [])]
    return cell


@pytest.fixture
def executed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., nbformat.NotebookNode]:
    """A function that runs all cells in an empty folder, and returns the notebook with its outputs.

    first: a cell before the others. The rest replaces parameters.
    """
    for name in ("IPYTHONDIR", "JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR"):
        monkeypatch.setenv(name, str(tmp_path / "jupyter"))
    work = tmp_path / "work"
    work.mkdir()

    def execute(first: str = "", **parameters: object) -> nbformat.NotebookNode:
        book = _read()
        _parameters(book).source += "".join(f"\n{name} = {value!r}" for name, value in parameters.items())
        book.cells.insert(0, nbformat.v4.new_code_cell(first))
        return NotebookClient(book, timeout=600, resources={"metadata": {"path": str(work)}}).execute()

    return execute


def _outputs(book: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    return [output for cell in book.cells for output in cell.get("outputs", [])]


def _displayed(book: nbformat.NotebookNode, kind: str) -> list[str]:
    """Return the outputs of the cells of one MIME type."""
    return [output.data[kind] for output in _outputs(book) if kind in output.get("data", {})]


@pytest.mark.slow
def test_the_demo_becomes_a_picture_and_a_page(executed, tmp_path):
    book = executed(CODE=str(ROOT), OUT=str(tmp_path / "out"), SECONDS=2, DEMO_WIDTH=40)
    assert len(_displayed(book, "image/png")) == len(_displayed(book, "image/jpeg")) == 1
    frame, link = _displayed(book, "text/html")
    page = html.unescape(re.search(r'<iframe [^>]*srcdoc="([^"]*)"', frame)[1])
    assert page == (tmp_path / "out/demo_40_model.html").read_text(encoding="utf-8")
    assert "href='../out/demo_40_model.zip'" in link
    with zipfile.ZipFile(tmp_path / "out/demo_40_model.zip") as archive:
        names = {"demo_40_model.html", "demo_40_model.html.jpg", "point_cloud.ply", "error_vs_time.png"}
        assert set(archive.namelist()) == names and archive.testzip() is None


def test_colab_asks_for_the_project_and_for_photos(executed, tmp_path):
    work = tmp_path / "work"
    with zipfile.ZipFile(work / "code.zip", "w") as code, zipfile.ZipFile(work / "photos.zip", "w") as photos:
        for name, text in PROGRAMS.items():
            code.writestr(f"gaussian-splatting-1/{name}.py", _HEAD + text)
        for number in range(3):
            photos.writestr(f"photo_{number}.png", b"")
    book = executed(COLAB.format(answers=["code.zip", "photos.zip"]), PHOTOS="upload", SECONDS=2)
    out = work / "project/gaussian-splatting-1/output/first_scene"
    assert "3 of 3 photos placed" in "".join(output.get("text", "") for output in _outputs(book))
    assert len(_displayed(book, "text/html")) == 1  # the page; Colab has no link to a file
    assert f"downloads: {[str(out / 'upload_model.zip')]}" in _outputs(book)[-1].text
    with zipfile.ZipFile(out / "upload_model.zip") as archive:
        assert {"upload_model.html", "point_cloud.ply"} < {*archive.namelist()}
