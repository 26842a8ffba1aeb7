"""`wpdc` and ``python -m wpdc_gwcs``: minimal, so that Ctrl-C works from the start."""

import gc
import os
import signal

__all__ = ["main", "prepare"]


def prepare():
    """Set the process up for its work, before NumPy is imported."""
    # Until the handler is installed, an interrupted program ends silently.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    # Imports create a hundred thousand permanent objects: a search for cycles after every 700 of
    # them takes a fifteenth of the time of a small frame.  Fewer searches than this would leave the
    # memory of thousands of files that were read to cycles for a long time.
    gc.set_threshold(20_000, 10, 10)
    # NumPy requests huge pages for large arrays.  The system clears each as a whole, outside the
    # cache, which takes twice the time of clearing small pages on first use.
    os.environ.setdefault("NUMPY_MADVISE_HUGEPAGE", "0")
    # The linear algebra of the package uses one thread (`wpdc_gwcs.threads`).  Others that OpenBLAS
    # starts would only spin for a while, for a tenth of the time of a small frame.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def main():
    """Run the command line."""
    prepare()
    from wpdc_gwcs.cli import main

    main()


if __name__ == "__main__":
    main()
