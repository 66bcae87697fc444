"""Release notes: the section of CHANGELOG.md of one version, printed for the page of a release.

python .ci/release_notes.py [VERSION]

VERSION, by default that of version.txt, may be a tag such as v0.1.0. Exit status 2 if the changelog has no section of
that version with a date, or if the version is not that of version.txt.
"""

import argparse
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r"\[([^\]]+)\]\((?!\w+:|#)[^)]+\)")


def release_notes(changelog: str, version: str) -> str:
    """Return the text of a version's section without its heading.

    A link to a file of the repository becomes its text, since a page elsewhere cannot follow it. ValueError if there is
    no such section, or nothing in it.
    """
    heading = rf"^## \[{re.escape(version)}\] - \d{{4}}-\d\d-\d\d\n"
    section = re.search(rf"{heading}(.*?)(?=^## |\Z)", changelog, re.MULTILINE | re.DOTALL)
    if section is None:
        raise ValueError(f"CHANGELOG.md has no section `## [{version}] - YYYY-MM-DD`; add it")
    if not section[1].strip():
        raise ValueError(f"the section of {version} in CHANGELOG.md is empty; say what has changed")
    return LINK.sub(r"\1", section[1].strip()) + "\n"


def main() -> int:
    """Print the notes; return the exit status."""
    current = (ROOT / "version.txt").read_text(encoding="utf-8").strip()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("version", nargs="?", default=current, help="as 0.1.0 or v0.1.0 (default: that of version.txt)")
    version = parser.parse_args().version.removeprefix("v")
    try:
        if version != current:
            raise ValueError(f"version.txt says {current}, not {version}; release the commit that is version {version}")
        print(release_notes((ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), version), end="")
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
