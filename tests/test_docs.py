"""README and docs: the length of lines, links, and the pages of the site."""

import re
from pathlib import Path
from urllib.parse import unquote

import pytest
from doc_pages import PAGES, ROOT, name_of, prose

MOST_LINES, MOST_COLUMNS = 130, 120
LINK = re.compile(r"\]\(([^()\s]+)\)")


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= MOST_LINES


@pytest.mark.parametrize("page", [page for page in PAGES if "results" not in page.parts], ids=name_of)
def test_lines_are_short(page):
    """Tables and figures have no other form. Code keeps its layout in the docs, but not in the README."""
    free = ("|", "![") if page.parent == ROOT else ("|", "![", "    ")
    lines = prose(page).splitlines()
    assert [line for line in lines if len(line) > MOST_COLUMNS and not line.startswith(free)] == []


def _anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as forges and MkDocs make them."""
    titles = re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE)
    plain = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", title) for title in titles)
    return {re.sub(r"\s+", "-", re.sub(r"[^\w\s-]", "", title).strip().lower()) for title in plain}


def _dead(page: Path, link: str) -> bool:
    path, _, anchor = unquote(link).partition("#")
    target = (page.parent / path).resolve() if path else page
    if not target.exists() or not target.is_relative_to(ROOT):
        return True
    return bool(anchor) and anchor not in _anchors(target)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_relative_links_resolve(page):
    links = [link for link in LINK.findall(prose(page)) if not re.match(r"[a-z]+:", link)]
    assert [link for link in links if _dead(page, link)] == []


def test_every_page_is_in_the_navigation():
    listed = re.findall(r"^\s+- .+: (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    docs = ROOT / "docs"
    pages = [page.relative_to(docs).as_posix() for page in PAGES if page.is_relative_to(docs)]
    assert sorted(listed) == sorted(
        [*pages, "benchmarks.md", "changelog.md", "contributing.md", "security.md"]
    )  # docs/hooks.py


def test_figures_of_the_readme_stand_in_the_results():
    """README copies rows of generated tables. A table made anew must not leave the copy behind."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    results = (ROOT / "docs" / "results" / "training.md").read_text(encoding="utf-8").splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in readme.splitlines()]
    scored = [row for row in rows if row[0] in ("CPU", "GPU")]
    assert len(scored) == 6
    for _, scene, iterations, *figures in scored:
        wanted = {scene, iterations, *figures}
        assert any(wanted <= {cell.strip() for cell in line.split("|")} for line in results), scene
