"""Picture of the viewer for the docs: the slider at a camera, and the curve of the training that goes on.

python tests/browser/viewer_picture.py SCENE docs/guide/images/viewer.jpg
"""

import argparse
import re
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from conftest import OPTIONS, chromium
from playwright.sync_api import Page, sync_playwright

SECONDS = 25  # of training that the curve shows
QUALITY = 85  # of the JPEG


def arrange(tab: Page, address: str) -> None:
    """Open the page, and choose what the picture shows."""
    tab.goto(address)
    tab.get_by_role("tab", name="Photos").click()
    tab.get_by_role("alert").get_by_role("button").first.click()
    tab.get_by_role("combobox", name="Camera").click()
    tab.get_by_role("option", name="train 7:").click()
    tab.get_by_role("combobox", name="Compare").click()
    tab.get_by_role("option", name="Slider").click()
    tab.get_by_role("tab", name="Training").click()
    tab.wait_for_timeout(1000 * SECONDS)
    tab.get_by_role("button", name="Pause").click()
    tab.wait_for_timeout(3000)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help="scene to train")
    parser.add_argument("picture", type=Path, help="JPEG to write")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        words = [
            "train.py",
            "-s",
            args.scene,
            "-m",
            Path(folder, "demo"),
            "--eval",
            "--iterations",
            20000,
            "--viewer",
            0,
        ]
        command = [sys.executable, *map(str, words)]
        process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
        try:
            address = next(filter(None, (re.search(r"viewer: (http://\S+)", line) for line in process.stderr)))[1]
            threading.Thread(target=process.stderr.read, daemon=True).start()
            with sync_playwright() as playwright:
                browser = playwright.chromium.launch(executable_path=chromium(), args=list(OPTIONS))
                tab = browser.new_page(viewport={"width": 1100, "height": 700})
                arrange(tab, address)
                args.picture.parent.mkdir(parents=True, exist_ok=True)
                tab.screenshot(path=args.picture, quality=QUALITY, type="jpeg")
                browser.close()
        finally:
            process.kill()
            process.wait()


if __name__ == "__main__":
    main()
