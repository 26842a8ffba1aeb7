"""`wpdc` and ``python -m wpdc_gwcs``: so little that Ctrl-C finds it ready at once."""

import gc
import os
import signal

__all__ = ["main"]


def main():
    """Run the command line."""
    # Until its own handler is there, an interrupted program ends without a word.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    # Half a million objects that stay come with the imports: to look through them for cycles after
    # every 700 takes a twelfth of the time of a small frame.
    gc.set_threshold(20_000, 10, 10)
    # NumPy asks for huge pages for large arrays.  The system clears each of them at once, out of
    # the cache of the processor, which takes twice the time of clearing small ones as they are met.
    os.environ.setdefault("NUMPY_MADVISE_HUGEPAGE", "0")
    from wpdc_gwcs.cli import main

    main()


if __name__ == "__main__":
    main()
