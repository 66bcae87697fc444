"""Limits on threads that spin while they wait for work. Import it before torch and NumPy.

Those of torch's OpenMP spin for milliseconds by default, and so block cores that other programs want. On two busy
cores, 300 iterations of a small scene took 42 s, and 9 s with short spinning. On idle cores both take 6 s.

Those of NumPy's OpenBLAS spin for a tenth of a second on every core after a single dot product of 10,000 numbers, as in
a histogram for TensorBoard. NumPy computes nothing here that is worth a second thread.
"""

import os

if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
