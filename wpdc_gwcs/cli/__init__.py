"""The command line: `wpdc`."""

import os

# The matrices here are small: threads of the linear algebra library gain little on an idle machine
# and, waiting for each other, cost several times the work on a busy one.  Frames run in parallel
# with --jobs instead.  It must be set before numpy is imported; what the user has set stays.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from wpdc_gwcs.cli.app import app, main  # noqa: E402

__all__ = ["app", "main"]
