"""Limit on the time for which threads of torch's OpenMP spin while they wait for work. Import it before torch.

By default they spin for milliseconds, and so block cores that other programs want. On two busy cores, 300
iterations of a small scene took 42 s, and 9 s with short spinning. On idle cores both take 6 s.
"""

import os

if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
