"""One thread of linear algebra per process: two workers with two threads each on two cores take half as long again."""

from __future__ import annotations

import os

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")  # workers and the programs that tests start inherit it
