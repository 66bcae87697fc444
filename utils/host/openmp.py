"""Import before torch: how the threads of torch's OpenMP wait for work.

By default they spin for milliseconds. Where another program wants the cores they then keep each other from working: 300
iterations of a small scene on two busy cores took 42 s so, and 9 s with short spinning. On idle cores both take 6 s.
"""

import os

if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
