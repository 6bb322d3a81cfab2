"""Command-line programs.

They compute with one BLAS thread: the arrays are small, more threads would get in the way of
other processes, and sums would depend on their number. The variables must be set before NumPy is
loaded.
"""

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")
