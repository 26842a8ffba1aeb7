"""`wpdc` and ``python -m wpdc_gwcs``: so little that Ctrl-C finds it ready at once."""

import gc
import os
import signal

__all__ = ["main", "prepare"]


def prepare():
    """Set the process up for its work, before NumPy is imported."""
    # Until its own handler is there, an interrupted program ends without a word.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    # With the imports come a hundred thousand objects that stay: to look through them for cycles
    # after every 700 takes a fifteenth of the time of a small frame.
    gc.set_threshold(20_000, 10, 10)
    # NumPy asks for huge pages for large arrays.  The system clears each of them at once, out of
    # the cache of the processor, which takes twice the time of clearing small ones as they are met.
    os.environ.setdefault("NUMPY_MADVISE_HUGEPAGE", "0")


def main():
    """Run the command line."""
    prepare()
    from wpdc_gwcs.cli import main

    main()


if __name__ == "__main__":
    main()
