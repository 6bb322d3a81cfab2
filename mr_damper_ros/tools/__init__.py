"""Command-line programs.

They compute with one BLAS thread: the arrays are small, more threads would get in the way of
other processes, and sums would depend on their number. NumPy heeds this only where it is loaded
afterwards.
"""

import os

from mr_damper_ros.processes.child_process import SINGLE_THREADED

os.environ.update({**SINGLE_THREADED, **os.environ})
