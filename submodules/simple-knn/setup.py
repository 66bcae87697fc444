import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent
sys.path.insert(0, str(ROOT.parent / "common"))

from build_extension import setup_extension  # noqa: E402

setup_extension(name="simple-knn", package="simple_knn", root=ROOT)
