"""Hooks of the site: pages from outside of docs/, train.py's options, search from a folder, a check for other hosts.

MkDocs calls the functions named `on_...` (mkdocs.yml, `hooks`).
"""

import logging
import posixpath
import re
import sys
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

# Page of the site by file of the repository.
PAGES = {
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security.md",
    "benchmarks/README.md": "benchmarks.md",
    "submodules/diff-gaussian-rasterization/csrc/README.md": "inside/rasterizer_sources.md",
}
OPTIONS = "reference/options.md"  # in the repository it says which command lists them
SOURCES = {page: source for source, page in PAGES.items()}
LINK = re.compile(r"(?<=\]\()([^()\s#:]+\.md)")
HELP = re.compile(r"(.*?)(?: \(default: (.*)\))?")  # of an option: its effect and its default
FLAG = re.compile(r"(?<![\w-])--?[a-z][\w-]*")
# What a browser loads by itself. A link (<a href>) is followed only when clicked.
LOADED = re.compile(r"<(?:script|img|iframe|source)\b[^>]*\bsrc=[\"']?(?:https?:)?//[^\"'> ]+", re.IGNORECASE)
STYLE = re.compile(r"<link\b[^>]*\bhref=[\"']?(?:https?:)?//[^>]*>", re.IGNORECASE)

log = logging.getLogger("mkdocs.hooks")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that lie outside of docs/."""
    root = Path(config.config_file_path).parent
    for source, page in PAGES.items():
        files.append(File.generated(config, page, content=(root / source).read_text(encoding="utf-8")))
    return files


def options_page(root: Path) -> str:
    """The options of train.py by topic, from its parser, which needs none of train.py's packages."""
    sys.path.insert(0, str(root))
    from arguments.launch import training_parser
    from arguments.option import TOPICS

    lines = ["# Options of train.py", "", "`train.py -h` lists the first group, and `train.py --help-all` all groups."]
    for topic, actions in training_parser()[0].by_topic().items():
        about = TOPICS[topic]
        lines += ["", f"## {topic.capitalize()}", "", f"{about[0].upper()}{about[1:]}.", ""]
        lines += ["| option | default | effect |", "| --- | --- | --- |"]
        for action in actions:
            effect, default = HELP.fullmatch(action.help.replace("%%", "%")).groups("")
            value = "" if action.nargs == 0 else " " + (action.metavar or f"{{{','.join(action.choices)}}}")
            name = f"`{', '.join(action.option_strings)}{value}`"
            lines.append(f"| {name} | {default} | " + FLAG.sub(r"`\g<0>`", effect) + " |")
    return "\n".join(lines) + "\n"


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Write the page of options. Links are relative to a page's place in the repository; point them into the site."""
    here = page.file.src_uri
    if here == OPTIONS:
        return options_page(Path(config.config_file_path).parent)
    folder = posixpath.dirname(SOURCES.get(here, f"docs/{here}"))

    def in_site(link: re.Match) -> str:
        target = posixpath.normpath(posixpath.join(folder, link[1]))
        target = PAGES.get(target, target.removeprefix("docs/"))
        return posixpath.relpath(target, posixpath.dirname(here) or ".")

    return LINK.sub(in_site, markdown)


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Warn, which `--strict` makes an error, of scripts, styles, fonts and images from other hosts."""
    found = LOADED.findall(output)
    found += [link for link in STYLE.findall(output) if "canonical" not in link]
    for source in found:
        log.warning("%s loads from another host: %s", page.file.src_uri, source)
    return output


@event_priority(-100)  # after the plugin of the search
def on_post_build(config: MkDocsConfig) -> None:
    """Write the index of the search as a script, too: pages that are opened from a folder cannot fetch JSON."""
    index = Path(config.site_dir) / "search" / "search_index.json"
    index.with_suffix(".js").write_text(f"var __index = {index.read_text(encoding='utf-8')}", encoding="utf-8")
